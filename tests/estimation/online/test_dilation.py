"""A dilation by rows equals OpenCV's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.estimation.online.mapping.keyframe_insertion import dilate_by_ellipse, surroundings


def blobs(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    mask = np.zeros(random.integers(5, 90, 2), bool)
    for _ in range(random.integers(0, 4)):
        y, x = random.integers(0, mask.shape)
        mask[y : y + random.integers(1, 20), x : x + random.integers(1, 20)] = True
    return mask | (random.random(mask.shape) < random.choice([0.0, 0.03]))


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("reach", [1, 3, 12, 29, 120])
def test_it_is_that_of_opencv(seed, reach):
    mask = blobs(seed)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    np.testing.assert_array_equal(
        dilate_by_ellipse(mask, reach), cv2.dilate(mask.astype(np.uint8), kernel) > 0
    )


def test_surroundings_are_beside_the_mask():
    mask = np.zeros((60, 80), bool)
    mask[20:40, 30:50] = True
    band = surroundings(mask)
    assert band.any() and not (band & mask).any()
    assert not band[:10].any() and band[18, 40]
