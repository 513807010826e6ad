"""A box or a mask says what the object is, and every way to get it wrong has its sentence."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d.trackers.prompts.prompt import make_prompt, parse_box

FRAME = Frame(0, np.zeros((48, 64, 3), dtype=np.uint8), name="000.png")


def some_mask() -> np.ndarray:
    mask = np.zeros((48, 64), dtype=bool)
    mask[10:30, 20:45] = True
    return mask


@pytest.mark.parametrize("text", ["1,2,3,4", " 1, 2 ,3,4 ", "1.0,2e0,3,4"])
def test_box_is_four_numbers(text):
    assert parse_box(text) == (1, 2, 3, 4)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a,b,c,d", "is not four numbers"),
        ("1,2,3,", "is not four numbers"),
        ("1,2,3,4px", "is not four numbers"),
        ("", "is not four numbers"),
        ("1,2,3", "is not four numbers"),
        ("1,2,3,4,5", "is not four numbers"),
        ("1 2 3 4", "is not four numbers"),
        ("1,2,nan,4", "not a finite number"),
        ("inf,2,3,4", "not a finite number"),
        ("1,2,0,4", "has no size"),
        ("1,2,3,-4", "has no size"),
    ],
)
def test_bad_box_is_refused_with_how_to_write_it(text, sentence):
    with pytest.raises(InputError, match=sentence):
        parse_box(text)


def test_box_inside_the_frame_is_kept(caplog):
    prompt = make_prompt(FRAME, box=(5, 6, 20, 30))
    assert prompt.box == (5, 6, 20, 30)
    assert prompt.mask is None
    assert not caplog.records


def test_box_partly_outside_is_clipped_with_a_note(caplog):
    with caplog.at_level(logging.WARNING):
        assert make_prompt(FRAME, box=(-4, 40, 20, 12)).box == (0, 40, 16, 8)
    assert "The box -4,40,20,12 extends beyond the frame" in caplog.text


@pytest.mark.parametrize(
    "box", [(64, 0, 5, 5), (-10, 0, 10, 10), (0, 48, 5, 5), (1e9, 0, 5, 5), (63.5, 0, 9, 9)]
)
def test_box_outside_the_frame_is_refused_with_the_frames_size(box):
    with pytest.raises(InputError, match=r"outside 000\.png, which is 64 x 48 pixels"):
        make_prompt(FRAME, box=box)


def test_box_of_no_size_is_refused_however_it_came():
    with pytest.raises(InputError, match="has no size"):
        make_prompt(FRAME, box=(5, 5, 0, 5))
    with pytest.raises(InputError, match="not a finite number"):
        make_prompt(FRAME, box=(5, 5, float("nan"), 5))


def test_mask_brings_its_box():
    prompt = make_prompt(FRAME, mask=some_mask())
    assert prompt.box == (20, 10, 25, 20)
    assert (prompt.mask == some_mask()).all()


@pytest.mark.parametrize(
    "image",
    [
        Image.fromarray(some_mask()),
        Image.fromarray((some_mask() * 255).astype(np.uint8)),
        Image.fromarray((some_mask() * 1).astype(np.uint8)),
        Image.fromarray((some_mask() * 65535).astype(np.uint16)),
        Image.fromarray((some_mask() * 255).astype(np.uint8)).convert("RGB"),
        Image.fromarray((some_mask() * 255).astype(np.uint8)).convert("CMYK"),
        Image.merge("LA", [Image.new("L", (64, 48)), Image.fromarray((some_mask() * 255).astype(np.uint8))]),
    ],
    ids=["bilevel", "grey", "labels", "16 bit", "colour", "cmyk", "alpha"],
)
def test_mask_file_is_any_image(tmp_path: Path, image):
    file = tmp_path / ("mask.tif" if image.mode == "CMYK" else "mask.png")
    image.save(file)
    assert (make_prompt(FRAME, mask=file).mask == some_mask()).all()


@pytest.mark.parametrize(
    ("mask", "sentence"),
    [
        (np.zeros((48, 64), dtype=bool), "mask=.* ?is empty"),
        (np.ones((48, 64), dtype=bool), r"covers all of 000\.png"),
        (np.ones((24, 32), dtype=bool), r"is 32 x 24 pixels, but 000\.png is 64 x 48"),
        (np.ones((64, 48), dtype=bool), "is 48 x 64 pixels"),
    ],
)
@pytest.mark.parametrize("as_file", [True, False])
def test_bad_mask_is_refused(tmp_path: Path, mask, sentence, as_file):
    Image.fromarray(mask).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match=sentence):
        make_prompt(FRAME, mask=tmp_path / "mask.png" if as_file else mask)


def test_mask_file_that_cannot_be_read_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"absent\.png does not exist"):
        make_prompt(FRAME, mask=tmp_path / "absent.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(InputError, match=r"text\.png cannot be read as an image"):
        make_prompt(FRAME, mask=tmp_path / "text.png")
    with pytest.raises(InputError, match="does not exist"):
        make_prompt(FRAME, mask=tmp_path)


def test_exactly_one_of_box_and_mask_is_wanted():
    with pytest.raises(InputError, match="one of a box, a mask or points"):
        make_prompt(FRAME)
    with pytest.raises(InputError, match="one of a box, a mask or points"):
        make_prompt(FRAME, (1, 1, 5, 5), some_mask())
