"""Training scenes: three frames with exact or taught masks, and from them one sample of the network's input."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from channels import CUE_LIMIT, LOG_LIMIT, Past, channels
from cutouts import Masked
from layers import Motion, about, translation
from mask_errors import damaged
from photometry import Camera

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

CANVAS = 192
"""Side of a stored sample in pixels; the crop for the network is cut from its middle."""

OBJECT = 100
"""Longer side of the object's box in it, about."""

PLANES = ("red", "green", "blue", "object", "occluder", "carried", "colours", "motion")


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a scene.

    Attributes:
        image: ``(CANVAS, CANVAS, 3)`` RGB.
        object: ``(CANVAS, CANVAS)`` in [0, 1], what is visible of the object.
        occluder: Likewise, of what is in front of it.
        confusing: Masks of what a tracker may take for the object.
    """

    image: Image
    object: Map
    occluder: Map
    confusing: list[Map]


@dataclass(frozen=True, eq=False)
class Scene:
    """A frame from long ago, the last and the present one; ``kind`` for statistics, ``knows_occluder`` for the loss."""

    first: Frame
    last: Frame
    present: Frame
    kind: str
    knows_occluder: bool


def sample_of(scene: Scene, rng: np.random.Generator) -> NDArray[np.uint8]:
    """``(8, CANVAS, CANVAS)`` uint8, see `PLANES`; log-odds are shifted to 128 and span the byte."""
    strength = float(rng.choice([0.0, 0.6, 1.0], p=[0.1, 0.5, 0.4]))
    first, last = (
        damaged(frame.object, frame.image, frame.confusing, rng, strength)
        for frame in (scene.first, scene.last)
    )
    carried, colours, motion = channels(
        Past(scene.first.image, first, scene.last.image, last), scene.present.image
    )
    present = scene.present
    return np.stack(
        [
            *present.image.transpose(2, 0, 1),
            _byte(255 * present.object),
            _byte(255 * present.occluder),
            _byte(255 * carried),
            _byte(128 + 127 * colours / LOG_LIMIT),
            _byte(128 + 127 * motion / CUE_LIMIT),
        ]
    )


def _byte(values: Map) -> NDArray[np.uint8]:
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def still_scene(item: Masked, rng: np.random.Generator) -> Scene:
    """A photograph and the teacher's mask; the frames before are the same picture, a camera's motion away."""
    x, y, width, height = item.box
    longest = max(width, height)
    scale = OBJECT * rng.uniform(0.92, 1.08) / longest
    wander = 0.08 * OBJECT
    centre = CANVAS / 2 + rng.uniform(-wander, wander), CANVAS / 2 + rng.uniform(-wander, wander)
    onto = translation(*centre) @ np.diag([scale, scale, 1]) @ translation(-x - width / 2, -y - height / 2)
    camera = Camera.draw(rng)
    if rng.random() < 0.5:  # as it is
        camera = Camera((1.0, 1.0, 1.0), 1.0, 0.0, 0.0, 0)
    small = Motion(shift=3, turn=2, scale=0.03, bend=0.02)
    large = Motion(shift=8, turn=10, scale=0.12, bend=0.06)
    frames = []
    for motion in (large, small, None):
        matrix = onto if motion is None else motion.draw((CANVAS / 2, CANVAS / 2), rng) @ onto
        image = _resampled(item.image, matrix)
        mask = np.clip(_resampled(item.soft, matrix, cv2.BORDER_CONSTANT), 0, 1)
        picture = camera.take(image.astype(np.float32), rng)
        hands = np.zeros_like(mask)
        if item.hands is not None:
            hands = np.clip(_resampled(item.hands, matrix, cv2.BORDER_CONSTANT), 0, 1)
        frames.append(Frame(picture, mask, hands, [] if item.hands is None else [hands]))
    return Scene(*frames, kind="still", knows_occluder=item.hands is not None)


def _resampled(image: NDArray, matrix: NDArray[np.float64], border: int = cv2.BORDER_REPLICATE) -> NDArray:
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    if scale < 0.7:
        small = cv2.resize(image, None, fx=1.3 * scale, fy=1.3 * scale, interpolation=cv2.INTER_AREA)
        matrix = matrix @ np.diag([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0], 1])
        image = small
    return cv2.warpPerspective(image, matrix, (CANVAS, CANVAS), flags=cv2.INTER_LINEAR, borderMode=border)


def background_frames(
    photograph: Image, moves: bool, rng: np.random.Generator
) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float64]]]:
    """A part of a photograph as three backgrounds, and the homographies from the present one to each."""
    rows, columns = photograph.shape[:2]
    side = float(min(rows, columns)) * rng.uniform(0.35, 0.95)
    left, top = rng.uniform(0, columns - side), rng.uniform(0, rows - side)
    onto = np.diag([CANVAS / side, CANVAS / side, 1]) @ translation(-left, -top)
    middle = (CANVAS / 2, CANVAS / 2)
    step = Motion(shift=4, turn=1.5, scale=0.02, bend=0.01)
    moved = [step.draw(middle, rng) if moves else np.eye(3) for _ in range(2)]
    motions = [about(middle, np.eye(3)) @ moved[0] @ moved[1], moved[1], np.eye(3)]
    frames = [
        _resampled(photograph, motion @ onto, cv2.BORDER_REFLECT).astype(np.float32) for motion in motions
    ]
    return frames, motions
