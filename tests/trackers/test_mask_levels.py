"""A grey mask that knows what is in front of the object says so by one level, and others are not misread."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from tracking3d.frames import OCCLUDER
from tracking3d.trackers.mask_images import ImageMasks

LEVELS = np.zeros((6, 8), np.uint8)
LEVELS[1:5, 2:5] = 255


def occluder_of(folder, levels) -> np.ndarray | None:
    Image.fromarray(levels).save(folder / "0.png")
    return ImageMasks(folder, [folder / "0.png"]).read_occluder(0)


def test_the_level_beside_the_object_is_an_occluder(tmp_path):
    levels = LEVELS.copy()
    levels[1:5, 5] = OCCLUDER
    np.testing.assert_array_equal(occluder_of(tmp_path, levels), levels == OCCLUDER)


@pytest.mark.parametrize("other", [None, 128])
def test_a_mask_without_it_or_with_soft_edges_says_nothing(tmp_path, other: int | None):
    levels = LEVELS.copy()
    if other is not None:
        levels[1:5, 5], levels[0, 2:5] = OCCLUDER, other
    assert occluder_of(tmp_path, levels) is None
