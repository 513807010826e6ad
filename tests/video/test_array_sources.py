"""Frames from the caller's own arrays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d.frames import Image, SkippedFrame
from tracking3d.video import FrameSource, open_source


def grey(value: int, shape: tuple[int, ...] = (4, 6, 3)) -> Image:
    return np.full(shape, value, np.uint8)


def test_a_list_of_arrays_is_a_source() -> None:
    source = open_source([grey(0), grey(1), grey(2)])
    assert isinstance(source, FrameSource)
    assert (source.count, source.fps, source.intrinsics) == (3, None, None)
    assert [(frame.index, int(frame.image[0, 0, 0]), frame.time) for frame in source] == [
        (0, 0, None),
        (1, 1, None),
        (2, 2, None),
    ]


def test_one_array_of_many_frames_is_a_source() -> None:
    assert open_source(np.zeros((5, 4, 6, 3), np.uint8)).count == 5


def test_a_generator_is_taken_one_at_a_time() -> None:
    taken = []

    def frames() -> Iterator[Image]:
        for value in range(100):
            taken.append(value)
            yield grey(value)

    source = open_source(frames(), ":4")
    assert source.count is None
    assert taken == []
    for position, frame in enumerate(source):
        assert frame.index == position
        assert taken == list(range(position + 1))
    assert taken == [0, 1, 2, 3]


def test_selected_frames_keep_their_index() -> None:
    source = open_source([grey(value) for value in range(10)], "1:9:3")
    assert source.count == 3
    assert [(frame.index, int(frame.image[0, 0, 0])) for frame in source] == [(1, 1), (4, 4), (7, 7)]


def test_a_buffer_that_is_written_over_does_not_change_earlier_frames() -> None:
    buffer = grey(0)

    def frames() -> Iterator[Image]:
        for value in range(3):
            buffer[:] = value
            yield buffer

    assert [int(frame.image[0, 0, 0]) for frame in list(open_source(frames()))] == [0, 1, 2]


def test_a_frame_of_another_size_is_skipped() -> None:
    frames = list(open_source([grey(0), grey(1, (4, 7, 3)), grey(2)]))
    assert isinstance(frames[1], SkippedFrame)
    assert "7 x 4" in frames[1].reason and "6 x 4" in frames[1].reason
    assert frames[2].index == 2


@pytest.mark.parametrize(
    ("item", "description"),
    [
        (np.zeros((4, 6), np.uint8), r"\(4, 6\) array of uint8"),
        (np.zeros((4, 6, 4), np.uint8), r"\(4, 6, 4\) array"),
        (np.zeros((0, 6, 3), np.uint8), r"\(0, 6, 3\) array"),
        (np.zeros((4, 6, 3)), "float64"),
        (None, "NoneType"),
        ("frame.png", "str"),
    ],
)
def test_what_is_no_rgb_array_is_an_input_error_that_names_the_frame(item: object, description: str) -> None:
    frames = iter(open_source([grey(0), item]))
    next(frames)
    with pytest.raises(InputError, match=f"Frame 1 .*{description}"):
        next(frames)


def test_no_frames_are_an_input_error() -> None:
    with pytest.raises(InputError, match="no frame"):
        list(open_source([]))


def test_what_cannot_be_iterated_is_an_input_error() -> None:
    with pytest.raises(InputError, match="int is not a source"):
        open_source(0)  # type: ignore[arg-type]
