"""DAVIS measures against the boundary counted by hand and pixel by pixel."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from tracking3d_bench.evaluation.boundary import (
    SequenceStatistics,
    boundary_f,
    boundary_map,
    davis_jaccard,
    davis_statistics,
)


def square(left, top=20, size=30, shape=(120, 160)):
    mask = np.zeros(shape, bool)
    mask[top : top + size, left : left + size] = True
    return mask


def blobs(seed, shape=(70, 90)):
    random = np.random.default_rng(seed)
    return ndimage.gaussian_filter(random.normal(size=shape), random.uniform(0.5, 8)) > 0


def slow_boundary(mask):
    """Every pixel compared with the neighbours that it has."""
    height, width = mask.shape
    found = np.zeros_like(mask)
    for y in range(height):
        for x in range(width):
            if y == height - 1 or x == width - 1:
                neighbours = [(y, x + 1)] if y == height - 1 else [(y + 1, x)]
            else:
                neighbours = [(y, x + 1), (y + 1, x), (y + 1, x + 1)]
            found[y, x] = any(
                ny < height and nx < width and mask[y, x] != mask[ny, nx] for ny, nx in neighbours
            )
    return found


def slow_f(mask, true):
    """Every boundary pixel against its distance to the other boundary."""
    radius = math.ceil(0.008 * math.sqrt(mask.shape[0] ** 2 + mask.shape[1] ** 2))
    a, b = (np.argwhere(slow_boundary(one)) for one in (mask, true))
    distances = np.linalg.norm(a[:, None] - b[None], axis=2)
    precision, recall = (distances.min(1) <= radius).mean(), (distances.min(0) <= radius).mean()
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def test_the_boundary_of_a_pixel_is_itself_and_its_neighbours_towards_the_origin():
    mask = np.zeros((5, 5), bool)
    mask[2, 2] = True
    expected = np.zeros_like(mask)
    expected[1:3, 1:3] = True
    np.testing.assert_array_equal(boundary_map(mask), expected)


def test_the_edge_of_the_frame_is_no_boundary():
    assert not boundary_map(np.ones((4, 6), bool)).any()


def test_the_last_row_looks_east_and_the_last_column_south():
    mask = np.zeros((3, 4), bool)
    mask[2, 2:] = True
    expected = np.array([[0, 0, 0, 0], [0, 1, 1, 1], [0, 1, 0, 0]], bool)
    np.testing.assert_array_equal(boundary_map(mask), expected)


@pytest.mark.parametrize("seed", range(5))
def test_the_boundary_is_the_one_found_pixel_by_pixel(seed):
    np.testing.assert_array_equal(boundary_map(blobs(seed)), slow_boundary(blobs(seed)))


@pytest.mark.parametrize("seed", range(8))
def test_f_is_the_one_found_by_distances(seed):
    assert boundary_f(blobs(seed), blobs(seed + 100)) == pytest.approx(
        slow_f(blobs(seed), blobs(seed + 100)), abs=1e-12
    )


def test_a_mask_agrees_with_itself():
    assert boundary_f(square(40), square(40)) == 1.0
    assert davis_jaccard(square(40), square(40)) == 1.0


def test_a_shift_within_the_tolerance_costs_no_boundary():
    # The diagonal of 120 x 160 is 200: 1.6 pixels, rounded up to 2.
    assert boundary_f(square(42), square(40)) == 1.0
    assert boundary_f(square(43), square(40)) < 1.0


def test_f_does_not_care_which_mask_is_which():
    assert boundary_f(square(40), square(60)) == boundary_f(square(60), square(40))


def test_a_far_mask_has_no_boundary_in_common():
    assert boundary_f(square(5), square(120)) == 0.0


def test_two_empty_masks_agree_and_one_empty_mask_does_not():
    empty = np.zeros((120, 160), bool)
    assert boundary_f(empty, empty) == davis_jaccard(empty, empty) == 1.0
    assert boundary_f(empty, square(40)) == boundary_f(square(40), empty) == 0.0
    assert davis_jaccard(empty, square(40)) == 0.0


def test_a_mask_that_fills_the_frame_has_no_boundary():
    assert boundary_f(np.ones((9, 9), bool), np.zeros((9, 9), bool)) == 1.0


def test_the_first_and_the_last_frame_are_left_out():
    values = [0.0, 0.4, 0.8, 0.6, 1.0, 0.0]
    statistics = davis_statistics(values)
    assert statistics == davis_statistics(values[1:-1], semi_supervised=False)
    assert statistics.mean == pytest.approx(0.7)
    assert statistics.recall == 0.75


def test_exactly_half_is_not_recalled():
    assert davis_statistics([0.5, 0.500001], semi_supervised=False).recall == 0.5


def test_decay_compares_the_first_with_the_last_quarter_and_they_share_their_end_frames():
    # Nine values: the quarters end at 0, 2, 4, 6 and 8.
    values = np.array([1.0, 0.8, 0.3, 0.5, 0.5, 0.5, 0.4, 0.1, 0.1])
    statistics = davis_statistics(values, semi_supervised=False)
    assert statistics.decay == pytest.approx(0.7 - 0.2)


def test_decay_of_a_steady_sequence_is_none_at_all():
    assert davis_statistics(np.full(30, 0.7)).decay == pytest.approx(0)


def test_long_sequences_have_a_decay_too():
    # The official tool counts frames in 8 bits and finds none beyond 256.
    assert davis_statistics(np.linspace(1, 0, 1001), semi_supervised=False).decay == pytest.approx(0.75)


def test_frames_without_a_value_are_not_recalled_and_do_not_move_the_mean():
    statistics = davis_statistics([np.nan, 0.8, 0.6, np.nan], semi_supervised=False)
    assert statistics.mean == pytest.approx(0.7)
    assert statistics.recall == 0.5


@pytest.mark.parametrize("values", [[], [0.5], [0.5, 0.5], [0.5, np.nan, 0.5]])
def test_without_frames_there_are_no_statistics(values):
    assert davis_statistics(values) is None


def test_a_single_frame_has_statistics():
    assert davis_statistics([0.1, 0.9, 0.1]) == SequenceStatistics(0.9, 1.0, 0.0)


@pytest.mark.parametrize("measure", [boundary_f, davis_jaccard])
def test_masks_of_another_size_or_type_are_refused(measure):
    with pytest.raises(ValueError, match=r"\(120, 160\), got \(5, 5\)"):
        measure(square(0, 0, 2, (5, 5)), square(40))
    with pytest.raises(ValueError, match="bool, got uint8"):
        measure(square(40).astype(np.uint8), square(40))


def test_values_with_two_axes_are_refused():
    with pytest.raises(ValueError, match=r"\(any\), got \(2, 3\)"):
        davis_statistics(np.ones((2, 3)))
