"""Finding the object again by its colours."""

from __future__ import annotations

import numpy as np
import pytest
from moving_shape import SIZE, iou, moving_shape

from tracking3d.geometry.camera import Window
from tracking3d.scene.view import crop_window
from tracking3d.trackers.colour_models import GlobalColours, lab
from tracking3d.trackers.crops import paste_mask
from tracking3d.trackers.outline import both_sides
from tracking3d.trackers.segmentation import find_by_colours


@pytest.fixture
def known() -> tuple[GlobalColours, float]:
    """The hexagon's colours and area."""
    frames, truth = moving_shape(1)
    window = Window(0, -30, 240, 224)
    mask = crop_window(truth[0].astype(np.float32), window)
    return GlobalColours(lab(crop_window(frames[0].image, window)), *both_sides(mask)), float(truth[0].sum())


@pytest.mark.parametrize("start", [40.0, 120.0, 190.0])
def test_the_object_is_found_wherever_it_is(known, start) -> None:
    frames, truth = moving_shape(1, start=start)
    mask, window, separation = find_by_colours(frames[0].image, *known, 0.45, 224)
    assert iou(paste_mask(mask, window, SIZE) > 0.5, truth[0]) > 0.85
    assert separation > 0.6


def test_the_background_alone_is_not_much_like_the_object(known) -> None:
    (frame,), truth = moving_shape(1, start=-300.0)
    assert not truth.any()
    found = find_by_colours(frame.image, *known, 0.45, 224)
    assert found is None or found[2] < 0.3


def test_what_was_there_without_the_object_is_not_it(known) -> None:
    frames, truth = moving_shape(1)
    there = truth[0].astype(np.float32)
    assert find_by_colours(frames[0].image, *known, 0.45, 224, there) is None
    mask, window, _ = find_by_colours(frames[0].image, *known, 0.45, 224, 1 - there)
    assert iou(paste_mask(mask, window, SIZE) > 0.5, truth[0]) > 0.85


@pytest.mark.parametrize("factor", [20, 1 / 20])
def test_something_of_another_size_is_not_the_object(known, factor) -> None:
    frames, _ = moving_shape(1)
    colours, area = known
    assert find_by_colours(frames[0].image, colours, factor * area, 0.45, 224) is None


def test_blank_and_tiny_images_are_answered(known) -> None:
    for size in ((40, 50), (1, 1), (3, 200)):
        found = find_by_colours(np.zeros((*size, 3), np.uint8), *known, 0.45, 64)
        assert found is None or found[0].shape == (64, 64)
