"""The RGB texture that is exported: what was seen, and a smooth continuation of it where nothing was."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tracking3d.estimation.shape import visible_texture
from tracking3d.rendering import BackProjection


def back_projection(colours: np.ndarray, weight: np.ndarray) -> BackProjection:
    """Of colours ``(T, T, 3)`` in [0, 255] seen with weights ``(T, T)``."""
    w = torch.tensor(weight, dtype=torch.float32)
    return BackProjection(torch.tensor(colours).permute(2, 0, 1).float() / 255 * w, w)


@pytest.fixture
def colours() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)


def test_a_texture_that_was_seen_everywhere_is_what_was_seen(colours):
    weight = np.full((16, 16), 0.7, np.float32)
    texture, seen = visible_texture(back_projection(colours, weight))
    np.testing.assert_array_equal(texture, colours)
    np.testing.assert_array_equal(seen, weight)


def test_views_are_averaged_by_their_weight(colours):
    dark = back_projection(np.zeros_like(colours), np.full((16, 16), 3.0))
    bright = back_projection(np.full_like(colours, 200), np.ones((16, 16)))
    texture, weight = visible_texture(dark + bright)
    assert (texture == 50).all()
    assert (weight == 4).all()


def test_what_was_not_seen_continues_its_neighbours_and_keeps_weight_zero():
    green = np.zeros((16, 16, 3), np.uint8)
    green[...] = 20, 180, 40
    weight = np.ones((16, 16))
    weight[5:9, 4:12] = 0
    texture, seen = visible_texture(back_projection(green, weight))
    assert np.abs(texture.astype(int) - green).max() <= 3
    np.testing.assert_array_equal(seen, weight)


def test_the_continuation_wraps_around_the_seam():
    grey = np.full((16, 16, 3), 100, np.uint8)
    grey[:, -3:] = 240
    weight = np.ones((16, 16))
    weight[:, :3] = 0
    texture, _ = visible_texture(back_projection(grey, weight))
    assert texture[:, 0].mean() > 170 > texture[:, 2].mean()


def test_what_was_seen_is_not_touched_by_the_continuation(colours):
    weight = (np.random.default_rng(1).random((16, 16)) > 0.3).astype(np.float32)
    texture, _ = visible_texture(back_projection(colours, weight))
    np.testing.assert_array_equal(texture[weight > 0], colours[weight > 0])


def test_an_object_never_seen_is_black(colours):
    texture, weight = visible_texture(back_projection(colours, np.zeros((16, 16))))
    assert not texture.any()
    assert not weight.any()
