"""Short synthetic sequences with exact masks: a textured shape that moves over clutter."""

from __future__ import annotations

import cv2
import numpy as np

from tracking3d.frames import Box, Frame

SIZE = (180, 240)


def clutter(
    seed: int, size: tuple[int, int], low: tuple[int, int, int], high: tuple[int, int, int]
) -> np.ndarray:
    """Smooth random colours between ``low`` and ``high``, ``(H, W, 3)`` float."""
    noise = np.random.default_rng(seed).random((*size, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2.0)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return np.asarray(low) + noise * (np.asarray(high) - np.asarray(low))


def moving_shape(
    count: int, step: float = 3.0, turn: float = 2.0, start: float = 60.0
) -> tuple[list[Frame], np.ndarray]:
    """A warm hexagon with a dent that drifts and turns over a cool background.

    Returns:
        The frames and their true masks ``(count, H, W)`` bool.
    """
    background = clutter(1, SIZE, (0, 40, 60), (90, 160, 255))
    texture = clutter(2, (160, 160), (120, 30, 0), (255, 200, 90))
    angles = np.radians([0, 60, 120, 180, 240, 300])
    outline = 80 + 45 * np.stack([np.cos(angles), np.sin(angles)], 1) * [
        [1.0],
        [1.0],
        [0.7],
        [1.0],
        [1.0],
        [1.0],
    ]
    stencil = np.zeros((160, 160), np.float32)
    cv2.fillPoly(stencil, [outline.round().astype(np.int32)], 1.0)
    frames, masks = [], []
    for index in range(count):
        place = cv2.getRotationMatrix2D((80, 80), turn * index, 1 + 0.005 * index)
        place[:, 2] += [start - 80 + step * index, 90 - 80 + 0.5 * index]
        shape = SIZE[::-1]
        mask = cv2.warpAffine(stencil, place, shape)[..., None]
        image = background * (1 - mask) + cv2.warpAffine(texture, place, shape) * mask
        frames.append(Frame(index, image.round().astype(np.uint8), name=f"frame {index}"))
        masks.append(mask[..., 0] > 0.5)
    return frames, np.stack(masks)


def box_around(mask: np.ndarray) -> Box:
    """The mask's bounding box."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return (float(x), float(y), float(width), float(height))


def iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return float((a & b).sum() / max((a | b).sum(), 1))
