"""What a camera in a hand does to the image of a still object is no change; a turn, a hand and another light are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from tracking3d.config.loading import load_config
from tracking3d.estimation.observation import mask_box, observe
from tracking3d.estimation.online.initialization.pending_frames import image_change
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window

WIDTH, HEIGHT = 320, 240
CAMERA = Camera.from_fov(WIDTH, HEIGHT, 45.0)
CROP = load_config(preset="default").crop


def drawn(
    *,
    covered: float = 0.0,
    thumb: int | None = None,
    known: bool = True,
    wide: float = 1.0,
    light: float = 1.0,
    warp=None,
    noise: int | None = None,
):
    """An observation of a shaded shape without symmetry.

    Args:
        covered: Share of its height that something hides from below.
        thumb: Row at which a thumb lies on it from the left.
        known: Whether the thumb is known to be in front of it.
        wide: Factor of its width, as if it turned.
        light: Factor of its brightness.
        warp: ``(2, 3)`` of the whole image.
        noise: Seed of one grey level of noise.
    """
    image = np.full((HEIGHT, WIDTH), 90, np.uint8)
    mask = np.zeros_like(image)
    cv2.ellipse(mask, (160, 120), (round(50 * wide), 70), 0, 0, 360, 255, cv2.FILLED)
    cv2.rectangle(mask, (160, 60), (160 + round(70 * wide), 90), 255, cv2.FILLED)
    x = np.clip((np.arange(WIDTH) - 90) / 140, 0, 1)
    shaded = np.broadcast_to(light * (120 + 80 * x), image.shape).clip(0, 255).astype(np.uint8)
    image = np.where(mask > 0, shaded, image)
    if covered:
        mask[round(190 - 140 * covered) :] = 0
    occluder = np.zeros(image.shape, bool)
    if thumb is not None:
        occluder[thumb : thumb + 30, :165] = True
        mask[occluder], image[occluder] = 0, 150
    if warp is not None:
        image = cv2.warpAffine(image, warp, (WIDTH, HEIGHT), borderValue=90)
        mask = cv2.warpAffine(mask, warp, (WIDTH, HEIGHT))
    if noise is not None:
        image = (image + np.random.default_rng(noise).integers(-1, 2, image.shape)).astype(np.uint8)
    binary = mask > 127
    box = mask_box(binary)
    assert box is not None
    window = Window.around(box, CROP.margin, CROP.size)
    frame = Frame(0, np.repeat(image[:, :, None], 3, axis=2), occluder=occluder if known else None)
    return observe(frame, binary, window, CAMERA, RgbEncoder(), torch.device("cpu"))


def similarity(degrees: float, scale: float, x: float, y: float) -> np.ndarray:
    matrix = cv2.getRotationMatrix2D((160, 120), degrees, scale)
    matrix[:, 2] += x, y
    return matrix


@pytest.mark.parametrize(
    ("degrees", "scale", "x", "y"), [(0, 1, 0, 0), (0, 1, 5.3, -3.7), (2, 1, 0, 0), (-3, 1.04, 6, 2)]
)
def test_a_shaking_camera_changes_nothing(degrees, scale, x, y):
    change = image_change(drawn(noise=1), drawn(warp=similarity(degrees, scale, x, y), noise=2))
    assert change.outline < 0.03
    assert change.shading < 0.01


def test_an_object_that_turns_changes_its_outline():
    assert image_change(drawn(), drawn(wide=0.85)).outline > 0.06


def test_a_hand_that_covers_a_part_changes_the_outline():
    assert image_change(drawn(), drawn(covered=0.3)).outline > 0.1


def test_a_thumb_that_moves_is_no_change_where_it_is_known_to_be_in_front():
    unknown, known = (
        image_change(drawn(thumb=100, known=seen), drawn(thumb=112, known=seen)) for seen in (False, True)
    )
    assert unknown.outline > 0.05
    assert known.outline < 0.01
    assert known.shading < 0.01
    turned = image_change(drawn(thumb=100), drawn(thumb=112, wide=0.85))
    assert turned.outline > 0.05


def test_another_light_changes_the_shading_and_not_the_outline():
    change = image_change(drawn(), drawn(light=0.8))
    assert change.outline < 0.01
    assert change.shading > 0.05


def test_without_a_mask_nothing_is_compared():
    seen = drawn()
    unseen = type(seen)(**{**vars(seen), "mask": torch.zeros_like(seen.mask)})
    assert image_change(seen, unseen) == image_change(unseen, seen)
    assert image_change(seen, unseen).outline == 0.0
