"""Which objects have texture that points can be followed by."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from patterns import disc, speckle

from tracking3d.estimation.online.features.klt import PLAIN, texture_strength

SIZE = (200, 240)
MASK = disc(SIZE, (110, 100), 60)
RAMP = np.tile(np.linspace(60, 180, SIZE[1]), (SIZE[0], 1))
EDGE = np.where(np.arange(SIZE[1]) < 110, 60.0, 180.0) * np.ones((SIZE[0], 1))


def grey(values: np.ndarray, noise: float = 0.0) -> np.ndarray:
    noisy = values + np.random.default_rng(0).normal(0, noise, values.shape) if noise else values
    return noisy.clip(0, 255).astype(np.uint8)


def test_a_print_has_texture_and_keeps_it_when_it_is_taken_nearer():
    near = cv2.resize(speckle(), None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    mask = cv2.resize(MASK.astype(np.uint8), None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST) > 0
    far = texture_strength(speckle(), MASK)
    assert far > 10 * PLAIN
    assert texture_strength(near, mask) == pytest.approx(far, rel=0.3)


@pytest.mark.parametrize("noise", [0.0, 2.0, 4.0])
@pytest.mark.parametrize("plain", [RAMP, EDGE], ids=["shade", "edge"])
def test_shade_an_edge_and_noise_are_no_texture(plain, noise):
    assert texture_strength(grey(plain, noise), MASK) < PLAIN


def test_what_lies_around_the_object_does_not_count():
    image = np.where(MASK, 120, speckle()).astype(np.uint8)
    assert texture_strength(image, MASK) < 0.1 * PLAIN


@pytest.mark.parametrize("mask", [np.zeros(SIZE, bool), disc(SIZE, (110, 100), 3)], ids=["empty", "tiny"])
def test_without_an_inside_there_is_none(mask):
    assert texture_strength(speckle(), mask) == 0.0
