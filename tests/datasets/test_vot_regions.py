"""Regions of VOT: hand-computed lines, round trips, what reaches beyond the frame, damaged lines."""

from __future__ import annotations

import numpy as np
import pytest
from written_datasets import HEIGHT, WIDTH, rectangle

from tracking3d.trackers.vot_regions import (
    EncodedMask,
    Polygon,
    Rectangle,
    Special,
    bounding_box,
    decode_mask,
    encode_mask,
    format_region,
    parse_region,
    rasterise,
)

FRAME = (HEIGHT, WIDTH)


def drawn(text):
    return rasterise(parse_region(text), FRAME)


def test_a_mask_line_is_a_box_and_runs_that_begin_with_zeros():
    expected = np.zeros(FRAME, bool)
    # Box of 3 x 2 at x = 5, y = 10: runs 1, 2, 3 are 0 11 000.
    expected[10, 6:8] = True
    assert (drawn("m5,10,3,2,1,2,3") == expected).all()


def test_a_mask_whose_first_pixel_is_set_begins_with_a_run_of_no_zeros():
    region = encode_mask(rectangle(2, 3, 4, 1))
    assert (region.left, region.top, region.width, region.height) == (2, 3, 4, 1)
    assert region.runs.tolist() == [0, 4]


def test_rows_follow_each_other_within_the_box():
    mask = np.zeros(FRAME, bool)
    mask[4, 7] = mask[4, 9] = mask[5, 8] = True
    assert format_region(encode_mask(mask)) == "m7,4,3,2,0,1,1,1,1,1,1"


def test_what_the_runs_leave_of_the_box_is_not_the_object():
    assert (drawn("m5,10,3,2,0,1") == rectangle(5, 10, 1, 1)).all()


@pytest.mark.parametrize("seed", range(20))
def test_any_mask_survives_encoding(seed):
    rng = np.random.default_rng(seed)
    mask = rng.random(FRAME) < rng.choice([0.01, 0.5, 0.99])
    region = encode_mask(mask)
    assert (rasterise(region, FRAME) == mask).all()
    assert (drawn(format_region(region)) == mask).all()


@pytest.mark.parametrize("mask", [np.zeros(FRAME, bool), np.ones(FRAME, bool)], ids=["empty", "full"])
def test_an_empty_and_a_full_mask_survive_encoding(mask):
    assert (drawn(format_region(encode_mask(mask))) == mask).all()


def test_an_empty_mask_has_a_box_without_size():
    assert format_region(encode_mask(np.zeros(FRAME, bool))) == "m0,0,0,0,0"
    assert not drawn("m0,0,0,0,0").any()


def test_a_mask_beyond_the_frame_is_cut_off():
    ones = EncodedMask(-2, -1, 4, 3, np.array([0, 12]))
    assert (rasterise(ones, FRAME) == rectangle(0, 0, 2, 2)).all()
    assert (drawn(f"m{WIDTH - 1},{HEIGHT - 2},4,4,0,16") == rectangle(WIDTH - 1, HEIGHT - 2, 1, 2)).all()
    assert not drawn("m100,100,2,2,0,4").any()


@pytest.mark.parametrize(
    ("text", "columns", "rows"),
    [  # first and last pixel as vot-toolkit 0.9.0 draws them
        ("2,3,4,5", (2, 5), (3, 7)),
        ("2.4,3.6,4.2,5.9", (2, 5), (3, 8)),
        ("-2.5,-1,6,5", (0, 2), (0, 3)),
        ("28,20,10,10", (28, 31), (20, 23)),
        ("2.9,3.9,4.0,5.0", (2, 5), (3, 7)),
    ],
)
def test_rectangles_cover_the_pixels_of_the_toolkit(text, columns, rows):
    y, x = np.nonzero(drawn(text))
    assert (x.min(), x.max()) == columns and (y.min(), y.max()) == rows
    assert len(x) == (columns[1] - columns[0] + 1) * (rows[1] - rows[0] + 1)


@pytest.mark.parametrize("text", ["0,0,0,0", "5,5,0,4", "5,5,4,0", "-9,-9,3,3", "-5.5,2,6,3"])
def test_rectangles_without_area_or_outside_are_empty(text):
    assert not drawn(text).any()


def test_a_polygon_includes_its_outline():
    assert (drawn("4,5,9,5,9,8,4,8") == rectangle(4, 5, 6, 4)).all()


def test_a_polygon_far_outside_the_frame_is_drawn_all_the_same():
    assert drawn("-1e9,-1e9,1e9,-1e9,1e9,1e9,-1e9,1e9").all()


def test_spaces_tabs_and_semicolons_separate_numbers_too():
    for text in ("2,3,4,5", "2 3 4 5", "2\t3\t4\t5", "2; 3; 4; 5", " 2, 3,  4 ,5 \n"):
        assert parse_region(text) == Rectangle(2, 3, 4, 5)


def test_codes_and_nan_are_no_region():
    assert parse_region("1") == Special(1)
    assert parse_region("nan,nan,nan,nan") == parse_region("NaN,2,3,4") == parse_region("0") == Special(0)
    assert not drawn("1").any() and not drawn("nan,nan,nan,nan").any()


def test_boxes_around_regions():
    assert bounding_box(Rectangle(-2.5, 3, 4, 5.5)) == (-2.5, 3, 4, 5.5)
    assert bounding_box(Polygon(((1, 2), (4, 0), (3, 6)))) == (1, 0, 3, 6)
    assert bounding_box(parse_region("m5,10,3,2,1,2,3")) == (6, 10, 2, 1)
    assert bounding_box(Rectangle(1, 2, 0, 3)) is None
    assert bounding_box(parse_region("m5,10,3,2,6")) is None
    assert bounding_box(Special(1)) is None


@pytest.mark.parametrize("region", [Rectangle(1.5, 2, 3, 4), Polygon(((1, 2), (4, 0.5), (3, 6))), Special(1)])
def test_regions_survive_writing(region):
    assert parse_region(format_region(region)) == region


def test_the_mask_within_its_box():
    assert decode_mask(parse_region("m5,10,3,2,1,2,3")).tolist() == [[False, True, True], [False] * 3]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "a number is missing"),
        ("1,2,,4", "a number is missing"),
        ("1,2,x,4", "'x' is not a number"),
        ("1,2", "2 numbers"),
        ("1,2,3,4,5", "5 numbers"),
        ("1,2,inf,4", "infinite"),
        ("10,5,-3,4", "10,5,-3,4 has a negative width or height"),
        ("10,5,3,-0.5", "10,5,3,-0.5 has a negative width or height"),
        ("m", "whole numbers"),
        ("m1,2,3", "runs"),
        ("m1,2,3,4.5,6", "whole numbers"),
        ("m1,2,3,4,nan", "whole numbers"),
        ("m1,2,-3,4,5", "negative"),
        ("m1,2,3,4,5,-5", "negative"),
        ("m1,2,3,2,4,3", "longer than its box of 3 x 2"),
        ("m1,2,1000000,1000000,1", "larger than any frame"),
        ("m1,2,3,2,99999999999999999999", "whole numbers"),
    ],
)
def test_damaged_lines_say_why(text, reason):
    with pytest.raises(ValueError, match=reason):
        parse_region(text)
