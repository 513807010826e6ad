"""Where a video is best to start with: texture that is followed while the object turns, whole and near."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from tracking3d.estimation.online.initialization.start_window import score_starts

SIZE, RADIUS = 160, 60


def turned(angle: float, seed: int = 0) -> np.ndarray:
    """A sphere with a random pattern, turned about the vertical axis; grey, on a plain ground."""
    pattern = np.random.default_rng(seed).uniform(0, 255, (40, 120))
    y, x = (np.mgrid[:SIZE, :SIZE] - SIZE / 2) / RADIUS
    inside = x**2 + y**2 < 1
    z = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    longitude = (np.arctan2(x, z) + angle) % (2 * np.pi) / (2 * np.pi) * 120
    latitude = (np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * 39
    image = map_coordinates(pattern, [latitude, longitude], order=1, mode="grid-wrap")
    return np.where(inside, image, 120).astype(np.uint8)


MASK = turned(0) != 120


def clip(angles, masks=None):
    """Frames with these angles in degrees."""
    return [
        (n, turned(np.radians(angle)), MASK if masks is None else masks[n]) for n, angle in enumerate(angles)
    ]


def test_the_start_of_the_motion_is_better_than_a_long_rest_before_it():
    angles = [0.0] * 70 + list(np.arange(0, 60, 1.5))
    scores = score_starts(clip(angles))
    best = max(scores, key=scores.get)
    assert best >= 30
    assert scores[0] < 0.2 * scores[best]


def test_an_object_that_stays_still_has_no_start():
    scores = score_starts(clip([0.0] * 30))
    assert scores
    assert max(scores.values()) < 0.05


def test_a_mask_that_is_cut_off_by_a_hand_is_a_worse_start():
    half = MASK & (np.arange(SIZE) < SIZE // 2)
    masks = [half if n < 10 else MASK for n in range(40)]
    scores = score_starts(clip(np.arange(0, 60, 1.5), masks))
    assert scores[0] < 0.7 * scores[10]


def test_a_frame_without_a_mask_is_no_start():
    masks = [None if n < 15 else MASK for n in range(40)]
    scores = score_starts(clip(np.arange(0, 60, 1.5), masks))
    assert min(scores) == 15


def test_nothing_comes_of_no_frames():
    assert score_starts([]) == {}
