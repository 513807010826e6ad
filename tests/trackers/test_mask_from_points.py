"""A first mask from points on the object and beside it."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.trackers.mask_from_points import mask_from_points

SQUARE = np.zeros((120, 160), bool)
SQUARE[30:80, 40:110] = True


def picture(noise: float = 4.0) -> np.ndarray:
    """A warm square before a cool background."""
    image = np.where(SQUARE[..., None], (200, 90, 40), (50, 90, 170)).astype(float)
    return np.clip(image + np.random.default_rng(0).normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def points(*rows: tuple[float, float, int]) -> np.ndarray:
    return np.float32(rows)


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_one_point_is_enough_for_what_stands_out():
    assert iou(mask_from_points(picture(), points((70, 50, 1))) > 0.5, SQUARE) > 0.97


def test_points_beside_hold_the_mask_back():
    image = picture()
    image[30:80, 75:110] = 60, 170, 60  # the half that is another thing
    left = SQUARE.copy()
    left[:, 75:] = False
    found = mask_from_points(image, points((50, 50, 1), (90, 50, 0))) > 0.5
    assert iou(found, left) > 0.9
    both = mask_from_points(image, points((50, 50, 1), (90, 50, 1), (10, 10, 0), (150, 110, 0))) > 0.5
    assert iou(both, SQUARE) > 0.9


def test_every_point_is_kept_to():
    clip = synthesize(SyntheticSpec(frames=1, size=(160, 120), supersample=1))
    rng = np.random.default_rng(1)
    inside, outside = (rng.permutation(np.argwhere(part))[:4] for part in (clip.masks[0], ~clip.masks[0]))
    told = points(*((x, y, 1) for y, x in inside), *((x, y, 0) for y, x in outside))
    found = mask_from_points(clip.images[0], told) > 0.5
    assert all(found[y, x] for y, x in inside)
    assert sum(found[y, x] for y, x in outside) == 0


def test_it_is_the_same_again():
    told = points((70, 50, 1), (10, 10, 0))
    assert (mask_from_points(picture(), told) == mask_from_points(picture(), told)).all()


@pytest.mark.parametrize("shape", [(2, 2), (3, 200), (40, 30)])
@pytest.mark.parametrize("value", [0, 128])
def test_nothing_to_see_is_no_fault(shape, value):
    image = np.full((*shape, 3), value, np.uint8)
    found = mask_from_points(image, points((0, 0, 1), (shape[1] - 1, shape[0] - 1, 0)))
    assert found.shape == shape
    assert np.isfinite(found).all()


def test_only_what_hangs_together_with_a_point_stays():
    image = picture()
    image[95:110, 120:150] = 200, 90, 40  # another thing of its colour
    assert not (mask_from_points(image, points((70, 50, 1))) > 0.5)[95:110, 120:150].any()
