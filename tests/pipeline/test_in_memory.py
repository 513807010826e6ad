"""Whatever the caller has his pictures in, the tracker sees the same."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video import FrameSource, open_source
from tracking3d.video.in_memory import CapturedFrames, open_frames

IMAGES = np.random.default_rng(0).integers(0, 256, (3, 6, 8, 3), np.uint8)  # neither side is 3


def channels_first() -> torch.Tensor:
    return torch.tensor(IMAGES).permute(0, 3, 1, 2)


KINDS = {
    "an array": lambda folder: IMAGES,
    "a list of arrays": lambda folder: list(IMAGES),
    "a tensor, channels first": lambda folder: channels_first(),
    "a tensor, channels last": lambda folder: torch.tensor(IMAGES),
    "a tensor of floats": lambda folder: channels_first().double() / 255,
    "a tensor with a gradient": lambda folder: (channels_first() / 255).requires_grad_(),
    "a list of tensors": lambda folder: list(channels_first()),
    "pictures of Pillow": lambda folder: [Image.fromarray(one) for one in IMAGES],
    "paths": lambda folder: sorted(folder.iterdir()),
    "texts of paths": lambda folder: [str(path) for path in sorted(folder.iterdir())],
    "a folder": lambda folder: folder,
    "a generator": lambda folder: (one for one in IMAGES),
    "frames": lambda folder: [Frame(index, image) for index, image in enumerate(IMAGES)],
    "a source": lambda folder: open_source(IMAGES),
}


@pytest.fixture
def folder(tmp_path):
    for index, image in enumerate(IMAGES):
        Image.fromarray(image).save(tmp_path / f"{index}.png")
    return tmp_path


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_same_pictures(kind, folder):
    source = open_frames(KINDS[kind](folder))
    assert isinstance(source, FrameSource)
    assert source.count == (None if kind == "a generator" else 3)
    for _ in range(2 if source.repeatable else 1):
        frames = list(source)
        assert [one.index for one in frames] == [0, 1, 2]
        np.testing.assert_array_equal([one.image for one in frames], IMAGES)
    assert source.repeatable == (kind != "a generator")


def test_every_float_of_a_picture_comes_back_to_its_own_value():
    ramp = torch.arange(256, dtype=torch.uint8).reshape(16, 16, 1).expand(16, 16, 3)
    for kind in (torch.float16, torch.float32, torch.float64):
        [frame] = open_frames((ramp.to(kind) / 255)[None])
        np.testing.assert_array_equal(frame.image, ramp)


@pytest.mark.parametrize("mode", ["L", "RGBA", "P", "1", "CMYK"])
def test_pictures_of_every_mode_are_seen_in_colour(mode):
    picture = Image.fromarray(IMAGES[0]).convert(mode)
    [frame] = open_frames([picture])
    np.testing.assert_array_equal(frame.image, np.asarray(picture.convert("RGB")))


def test_a_buffer_that_is_used_again_is_copied():
    buffer = torch.zeros(6, 8, 3, dtype=torch.uint8)

    def decoded():
        for value in (1, 2):
            yield buffer.fill_(value)

    assert [int(frame.image.max()) for frame in list(open_frames(decoded()))] == [1, 2]


def test_frames_that_could_not_be_read_are_passed_on():
    skipped = SkippedFrame(1, "torn")
    assert list(open_frames([Frame(0, IMAGES[0]), skipped]))[1] is skipped


@pytest.fixture
def video(tmp_path):
    path = str(tmp_path / "clip.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"FFV1"), 20, (8, 6))
    for image in IMAGES:
        writer.write(image[..., ::-1])
    writer.release()
    return path


def test_a_capture_is_read_from_where_it_stands_and_stays_open(video):
    capture = cv2.VideoCapture(video)
    assert capture.read()[0]
    source = open_frames(capture)
    assert source.count == 2
    assert source.fps == 20
    for _ in range(2):
        frames = list(source)
        assert [one.index for one in frames] == [0, 1]
        assert [one.time for one in frames] == [0, 0.05]
        np.testing.assert_array_equal([one.image for one in frames], IMAGES[1:])
    assert capture.isOpened()


class Stuck:
    """A capture that knows its length, but does not go back."""

    def __init__(self) -> None:
        self._left = list(IMAGES)

    def set(self, what: int, value: float) -> bool:
        return False

    def read(self):
        return True, self._left.pop(0)


def test_a_capture_that_does_not_go_back_is_not_taken_for_one_that_does():
    source = CapturedFrames(Stuck(), start=0, count=3, fps=None)
    next(iter(source))
    with pytest.raises(InputError, match=r"^the VideoCapture cannot be rewound to frame 0"):
        next(iter(source))


def test_a_capture_at_its_end_has_no_frame(video):
    capture = cv2.VideoCapture(video)
    while capture.read()[0]:
        pass
    with pytest.raises(InputError, match=r"^the VideoCapture has no readable frame left"):
        list(open_frames(capture))
