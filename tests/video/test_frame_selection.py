"""``--frames START:STOP:STEP`` and the order of files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tracking3d.errors import InputError
from tracking3d.video import natural_order, parse_selection


@pytest.mark.parametrize(
    "text", ["0:5", "2:9", "2:9:3", ":4", "3:", "::2", ":", "::", "7::4", " 1 : 5 ", "0:100:7"]
)
def test_the_selection_is_a_python_slice(text: str) -> None:
    everything = list(range(12))
    parts = [int(part) if part.strip() else None for part in text.split(":")]

    selection = parse_selection(text)

    assert [index for index in everything if index in selection] == everything[slice(*parts)]


def test_without_text_every_frame_is_selected() -> None:
    assert all(index in parse_selection(None) for index in (0, 1, 10**9))


def test_a_selection_ends_with_its_last_frame_so_that_no_frame_is_decoded_in_vain() -> None:
    assert parse_selection("0:20:5").stop == 16


@pytest.mark.parametrize(
    "text", ["", "5", "a:b", "0:5:2:1", "-3:", "0:-1", "1.5:3", "0:5:0", "5:5", "9:2", "٣:٤", "1_0:20"]
)
def test_bad_selections_are_named_in_one_sentence(text: str) -> None:
    with pytest.raises(InputError) as error:
        parse_selection(text)
    assert repr(text) in str(error.value)
    assert "\n" not in str(error.value)


def test_numbers_in_names_count_as_numbers() -> None:
    names = ["10.png", "2.png", "a10b2.png", "a2b10.png", "A3.png", "frame.png", "01.png", "1.png"]
    ordered = [path.name for path in sorted(map(Path, names), key=natural_order)]
    assert ordered == ["01.png", "1.png", "2.png", "10.png", "a2b10.png", "A3.png", "a10b2.png", "frame.png"]
