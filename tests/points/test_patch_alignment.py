from __future__ import annotations

import cv2
import numpy as np
import pytest
from twins import patch_alignment

from tracking3d.points.warping import align

SIZE = 64


def painted(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (SIZE, SIZE)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2.0) * 4 - 380


def moved(image: np.ndarray, shift: tuple[float, float]) -> np.ndarray:
    return cv2.warpAffine(
        image, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), (SIZE, SIZE), flags=cv2.INTER_CUBIC
    )


KNOWN = np.ones((SIZE, SIZE), np.float32)
POINTS = np.array([[20.0, 25.0], [31.5, 33.25], [40.0, 22.0]])


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, -0.7), (-1.6, 1.1)])
def test_a_shift_is_found_to_a_tenth_of_a_pixel_whatever_the_light(shift):
    image = moved(painted(), shift) * 1.3 + 20
    found = align(painted(), KNOWN, image, POINTS, prior=3.0)
    assert np.abs(found.shift - shift).max() < 0.1
    assert (found.agreement > 0.98).all()
    assert (found.variance < 0.1).all()


def test_the_kernel_says_what_its_twin_says():
    rng = np.random.default_rng(1)
    xy = np.concatenate([rng.uniform(-10, SIZE + 10, (60, 2)), [[np.nan, 3.0]]])
    known = (painted(2) > 90).astype(np.float32)
    given = painted(), known, moved(painted(), (0.6, 0.3)), xy
    results = align(*given), patch_alignment.align(*given)
    for name in ("shift", "covariance", "agreement", "contrast"):
        one, other = (getattr(result, name) for result in results)
        assert np.allclose(one, other, atol=2e-3, rtol=2e-3), name


def test_without_texture_the_prediction_stands_and_the_variance_says_so():
    flat = np.full((SIZE, SIZE), 90, np.float32)
    found = align(flat, KNOWN, flat + 5, POINTS, prior=1.5)
    assert np.abs(found.shift).max() < 1e-6
    assert np.allclose(found.variance, 1.5**2, rtol=0.01)


def test_along_an_edge_nothing_is_known():
    edge = cv2.GaussianBlur(np.where(np.arange(SIZE) < 32, 40.0, 200.0)[None].repeat(SIZE, 0), (0, 0), 1)
    found = align(
        edge.astype(np.float32), KNOWN, moved(edge.astype(np.float32), (0.5, 0.9)), np.array([[32.0, 32.0]]),
    )  # fmt: skip
    assert found.shift[0] == pytest.approx([0.5, 0.0], abs=0.1)
    assert found.covariance[0, 0] < 0.1 < 0.9 < found.covariance[0, 2]


def test_what_is_hidden_or_outside_is_not_aligned():
    hidden = align(painted(), np.zeros_like(KNOWN), painted(), POINTS)
    outside = align(painted(), KNOWN, painted(), np.array([[-50.0, 3.0], [np.nan, 3.0]]))
    for found in (hidden, outside):
        assert np.isinf(found.covariance).all()
        assert (found.agreement == -1).all()
        assert (found.shift == 0).all()
