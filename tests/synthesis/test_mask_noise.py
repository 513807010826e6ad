"""Masks with one known fault: boundary noise of a known size and mean zero, and a hand for stretches of frames."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from tracking3d_bench.synthesis.mask_noise import (
    HAND_OFF,
    HAND_ON,
    boundary_distance,
    noisy_boundaries,
    with_hand,
)

FRAMES, SIZE, RADIUS = 60, 120, 30


@pytest.fixture(scope="module")
def discs():
    """A disc that moves to the right."""
    y, x = np.indices((SIZE, SIZE))
    return np.stack([np.hypot(x - 40 - 0.4 * n, y - 60) < RADIUS for n in range(FRAMES)])


def test_the_signed_distance_of_a_half_plane_is_the_distance_to_its_edge():
    mask = np.zeros((7, 9), bool)
    mask[:, 4:] = True  # the edge is between columns 3 and 4
    assert boundary_distance(mask)[3] == pytest.approx(np.arange(9) - 3.5, abs=1e-6)


@pytest.mark.parametrize("pixels", [0.5, 1.5, 3.0])
def test_noise_has_the_asked_size_and_the_mean_zero(discs, pixels):
    noisy = noisy_boundaries(discs, pixels, seed=1)
    # Where the boundary is: along many rays from the centre, how far the mask reaches.
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    steps = np.arange(0, RADIUS + 20, 0.1)
    shifts = []
    for n in range(1, FRAMES):
        columns = np.round(40 + 0.4 * n + steps[:, None] * np.cos(angles)).astype(int)
        rows = np.round(60 + steps[:, None] * np.sin(angles)).astype(int)
        shifts.append(0.1 * (noisy[n][rows, columns].sum(0) - discs[n][rows, columns].sum(0).astype(float)))
    shifts = np.array(shifts)
    assert shifts.mean() == pytest.approx(0, abs=0.12 * pixels)
    assert shifts.std() == pytest.approx(pixels, rel=0.25)
    assert noisy.sum() == pytest.approx(discs.sum(), rel=0.02)


def test_noise_is_new_in_every_frame_and_the_same_for_one_seed(discs):
    noisy = noisy_boundaries(discs, 2.0, seed=3)
    assert (noisy == noisy_boundaries(discs, 2.0, seed=3)).all()
    assert (noisy != noisy_boundaries(discs, 2.0, seed=4)).any()
    faults = noisy ^ discs
    shared = [np.count_nonzero(a & b) / np.count_nonzero(a) for a, b in pairwise(faults[1:])]
    assert np.mean(shared) < 0.5


@pytest.mark.parametrize("roughen", [lambda m: noisy_boundaries(m, 3.0, 0), lambda m: with_hand(m, 0)])
def test_the_first_frame_keeps_its_mask_and_empty_frames_stay_empty(discs, roughen):
    masks = discs.copy()
    masks[[7, 20]] = False
    rough = roughen(masks)
    assert rough.dtype == bool and (rough[0] == masks[0]).all() and (rough[1:] != masks[1:]).any()
    assert not rough[[7, 20]].any()


@pytest.mark.parametrize("pixels", [0, -1, float("nan"), float("inf")])
def test_noise_without_a_size_is_refused(discs, pixels):
    with pytest.raises(ValueError, match="positive"):
        noisy_boundaries(discs, pixels, 0)


def test_a_hand_comes_and_goes_and_only_ever_adds(discs):
    rough = with_hand(discs, seed=2)
    assert (rough | ~discs).all()
    there = (rough != discs).any((1, 2))
    starts, ends = (
        np.flatnonzero(np.diff(there.astype(int)) == 1),
        np.flatnonzero(np.diff(there.astype(int)) == -1),
    )
    assert len(starts) == 4 and (ends[:3] - starts[:3] == HAND_ON).all()
    assert (starts[1:] - ends[: len(starts) - 1] == HAND_OFF).all()


def test_a_hand_is_one_piece_with_the_object_and_reaches_the_border(discs):
    rough = with_hand(discs, seed=2)
    for n in np.flatnonzero((rough != discs).any((1, 2))):
        assert cv2.connectedComponents(rough[n].astype(np.uint8))[0] == 2, n
        added = rough[n] & ~discs[n]
        assert 0.1 < added.sum() / discs[n].sum() < 0.8
        assert np.concatenate([added[0], added[-1], added[:, 0], added[:, -1]]).any()


def test_every_time_the_hand_comes_from_another_side(discs):
    rough = with_hand(discs, seed=2)
    middles = [np.argwhere(rough[n] & ~discs[n]).mean(0) - (60, 40 + 0.4 * n) for n in (8, 26, 44)]
    angles = [np.arctan2(*middle) for middle in middles]
    assert min(abs(np.angle(np.exp(1j * (a - b)))) for a, b in pairwise(angles)) > 0.5
