"""Distances to the nearest pixel of a set: exact, and the same wherever the image lies in memory."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from tracking3d.geometry.camera import pixel_distance


def ellipse(size: tuple[int, int], degrees: int) -> np.ndarray:
    height, width = size
    mask = np.zeros(size, np.uint8)
    cv2.ellipse(mask, (width // 2, height // 2), (width * 3 // 10, height // 4), degrees, 0, 360, 1, -1)
    return mask > 0


@pytest.mark.parametrize("seed", range(20))
def test_distances_are_correctly_rounded_wherever_the_image_lies(seed):
    rng = np.random.default_rng(seed)
    pixels = ellipse(tuple(rng.integers(20, 500, 2)), int(rng.integers(180)))
    exact = distance_transform_edt(~pixels).astype(np.float32)
    for _ in range(5):
        elsewhere = [rng.random(int(rng.integers(1, 100_000))) for _ in range(4)]
        del elsewhere[::2]
        np.testing.assert_array_equal(pixel_distance(pixels.copy()), exact)


def test_an_empty_set_is_further_than_any_pixel():
    assert (pixel_distance(np.zeros((4, 5), bool)) == 9).all()
