"""Holes of a mask: those that are the object itself are filled, those through which something else is seen are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop
from tracking3d.trackers.segmentation import fill_own_holes

SIZE = 120
SKIN, WOOD, METAL, WHITE = (200, 150, 130), (190, 170, 120), (110, 110, 115), (240, 240, 245)
HOLE = np.s_[50:70, 45:75]


def filled(
    colour: tuple[int, int, int],
    along: float,
    occluder: bool = False,
    mouth: int = 0,
    hand: bool = False,
) -> np.ndarray:
    """What becomes of a white square's mask with a hole of a colour, ``(S, S)``; ``mouth`` opens it to the right."""
    image = np.full((SIZE, SIZE, 3), WOOD, np.uint8)
    image[:, :15] = SKIN if hand else WOOD
    mask = np.zeros((SIZE, SIZE), bool)
    mask[30:90, 30:90] = True
    image[mask] = WHITE
    hole = np.zeros_like(mask)
    hole[HOLE] = True
    if mouth:
        hole[60 - mouth // 2 : 60 + mouth // 2, 75:90] = True
    image[hole] = colour
    moved = np.where(hole, along, 0).astype(np.float32)
    crop = FrameCrop.of(cv2.GaussianBlur(image, (3, 3), 0), Window(0, 0, SIZE, SIZE))
    return fill_own_holes(mask & ~hole, crop, moved, hole & occluder)


def test_a_hinge_of_metal_that_moves_with_the_object_is_its_own() -> None:
    assert filled(METAL, along=5.0)[HOLE].all()


def test_what_is_seen_through_a_hole_is_not_the_object() -> None:
    assert not filled(WOOD, along=5.0)[HOLE].any(), "it has the colour of what lies around"
    assert not filled(METAL, along=0.0)[HOLE].any(), "it has not moved with the object"
    assert not filled(METAL, along=-5.0)[HOLE].any()


def test_what_the_object_surrounds_is_no_occluder_unless_it_looks_like_the_hand_around_it() -> None:
    assert filled(METAL, along=0.5, occluder=True)[HOLE].all()
    assert not filled(METAL, along=-0.5, occluder=True)[HOLE].any()
    assert not filled(SKIN, along=5.0, occluder=True, hand=True)[HOLE].any(), "a finger through a handle"


@pytest.mark.parametrize(("mouth", "own"), [(2, True), (20, False)])
def test_a_hole_may_have_a_narrow_gap_in_its_border(mouth: int, own: bool) -> None:
    assert filled(METAL, along=5.0, mouth=mouth)[HOLE].any() == own


def test_a_mask_without_holes_stays_as_it_is() -> None:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[30:90, 30:90] = True
    crop = FrameCrop.of(np.zeros((SIZE, SIZE, 3), np.uint8), Window(0, 0, SIZE, SIZE))
    nothing = np.zeros((SIZE, SIZE), np.float32)
    for one in (mask, ~mask, np.zeros_like(mask), np.ones_like(mask)):
        assert np.array_equal(fill_own_holes(one, crop, nothing, nothing > 0), one)
