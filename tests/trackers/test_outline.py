"""Outlines: priors, shifts, sides, and what is tidied away."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.trackers.outline import (
    both_sides,
    inside_distance,
    prior,
    remove_specks,
    shifted_to,
    touches_border,
)


def square(top: int = 30, left: int = 30, side: int = 40, size: int = 100) -> np.ndarray:
    mask = np.zeros((size, size), bool)
    mask[top : top + side, left : left + side] = True
    return mask


def test_the_signed_distance_counts_from_the_outline() -> None:
    distance = inside_distance(square())
    assert distance[50, 30] == pytest.approx(1, abs=0.1) and distance[50, 29] == pytest.approx(-1, abs=0.1)
    assert distance[50, 20] == pytest.approx(-10, abs=0.5)


def test_the_prior_is_the_weighted_mean_of_opinions_in_units_of_the_size() -> None:
    near, far = square().astype(np.float32), square(left=40).astype(np.float32)
    both = prior([(3.0, near), (1.0, far)], 1600)
    expected = (3 * inside_distance(near > 0) + inside_distance(far > 0)) / 4 / (0.12 * 40)
    np.testing.assert_allclose(both, np.clip(expected, -4, 4), atol=1e-5)


@pytest.mark.parametrize(("down", "right"), [(0, 0), (6, -4), (-8, 10)])
def test_a_mask_is_shifted_to_where_the_evidence_is(down: int, right: int) -> None:
    evidence = np.where(square(30 + down, 30 + right), 1, -1).astype(np.float32)
    found = shifted_to(square().astype(np.float32), evidence)
    np.testing.assert_array_equal(found > 0.5, square(30 + down, 30 + right))


def test_without_evidence_a_mask_stays_where_it_is() -> None:
    mask = square().astype(np.float32)
    np.testing.assert_array_equal(shifted_to(mask, np.zeros((100, 100), np.float32)), mask)


def test_the_sides_leave_a_band_out() -> None:
    inside, around = both_sides(square().astype(np.float32))
    np.testing.assert_array_equal(inside, square())
    assert not (inside & around).any() and not (inside | around).all()
    assert around[50, 20] and not around[50, 29]


def test_a_mask_at_the_border_of_the_frame_touches_it() -> None:
    in_frame = np.zeros((100, 100), bool)
    in_frame[:, 20:] = True
    assert touches_border(square(left=21), in_frame)
    assert not touches_border(square(left=30), in_frame)
    assert not touches_border(square(), np.ones((100, 100), bool))


def assert_same_but_corners(mask: np.ndarray, expected: np.ndarray) -> None:
    """Opening rounds every corner by a pixel."""
    assert np.count_nonzero(mask != expected) <= 8


def test_specks_pinholes_and_parts_that_were_not_there_are_dropped() -> None:
    mask = square()
    mask[50, 50] = False
    mask[5, 5] = True
    mask[80:95, 75:95] = True
    assert_same_but_corners(remove_specks(mask, square()), square())


def test_a_hole_that_is_no_pinhole_stays() -> None:
    mask = square()
    mask[40:50, 40:50] = False
    assert_same_but_corners(remove_specks(mask, mask), mask)


def test_a_part_that_moves_with_the_background_is_dropped() -> None:
    other = square(80, 75, 15)
    mask = square() | other
    assert_same_but_corners(remove_specks(mask, mask), mask)
    motion = np.where(other, -1.0, 1.0).astype(np.float32)
    assert_same_but_corners(remove_specks(mask, mask, motion), square())
    assert_same_but_corners(remove_specks(mask, mask, -np.ones_like(motion)), mask)
