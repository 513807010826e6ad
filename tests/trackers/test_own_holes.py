"""Holes of a mask that are the object itself are filled, others are not; sides that turn into view are taken in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from moving_shape import iou

from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop, crop_window
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.segmentation import ColourSegmentation, fill_own_holes

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


class Network:
    """Says where the object is as it is told, and that nothing is in front of it."""

    def __init__(self, truth: np.ndarray, odds: float) -> None:
        self.truth, self.odds = truth, odds

    def log_odds(self, image, present, motion, colours, last):  # type: ignore[no-untyped-def]
        where = crop_window(self.truth, present.window) > 0.5
        return np.where(where, self.odds, -4).astype(np.float32), np.full(where.shape, -4, np.float32)


@pytest.mark.parametrize(("odds", "taken"), [(4.0, True), (1.5, False)])
def test_a_side_that_turns_into_view_at_once_is_taken_if_the_network_is_sure(
    odds: float, taken: bool
) -> None:
    """A mask that grows by more than a third is refused otherwise, if the background is not known."""
    noise = np.random.default_rng(0).normal(0, 3, (SIZE, SIZE, 3))
    images, masks = [], []
    for right in (60, 90):
        mask = np.zeros((SIZE, SIZE), bool)
        mask[40:80, 30:right] = True
        image = np.where(mask[..., None], WHITE, WOOD) + noise
        images.append(image.clip(0, 255).astype(np.uint8))
        masks.append(mask)
    network, cues = Network(masks[1], odds), Cues(background=0.0)
    segmentation = ColourSegmentation(images[0], (30, 40, 30, 40), masks[0], cues=cues, network=network)
    found = segmentation.step(images[1]).binary
    assert found is not None
    assert iou(found, masks[1 if taken else 0]) > 0.85
