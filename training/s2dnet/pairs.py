"""Training pairs: two images and points known to be the same in both.

Pixel (0, 0) is the centre of the top-left pixel, points are (x, y).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from photometry import FloatImage, disturb

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

CANVAS = 1.5
"""Side of a crop's canvas over the side of a training image: what warped views may see around it."""


SHIFT = 0.4
"""Views are shifted by up to so much of their side: where something lies in the image must not describe it."""

_TRIES = 3  # crops with texture teach more: the best of so many


@dataclass(frozen=True, eq=False)
class Pair:
    """Two views.

    Attributes:
        images: Two of ``(S, S, 3)`` float32 RGB in [0, 1].
        points: Two of ``(N, 2)`` float32 pixels, the same points in both images.
        crop: Where the points come from, an index of the pool of crops, and -1 in rendered pairs.
        order: ``(N,)`` which of the crop's fixed points these are.
    """

    images: tuple[FloatImage, FloatImage]
    points: tuple[NDArray[np.float32], NDArray[np.float32]]
    crop: int
    order: NDArray[np.int64]


def make_canvas(
    photographs: Sequence[Image], cutouts: Sequence[Image], size: int, rng: np.random.Generator
) -> Image:
    """A random crop ``(size, size, 3)`` of a photograph at a random scale, with up to three cutouts pasted on it.

    Args:
        photographs: ``(H, W, 3)`` RGB.
        cutouts: ``(H, W, 4)`` RGBA.
        size: Side in pixels.
        rng: The source of all randomness.
    """
    tries = [_region(photographs, size, rng) for _ in range(_TRIES)]
    canvas = max(tries, key=lambda region: float(np.abs(cv2.Laplacian(region, cv2.CV_32F)).mean()))
    for _ in range(int(rng.integers(0, 4)) if cutouts else 0):
        canvas = _pasted(canvas, cutouts[rng.integers(len(cutouts))], rng)
    return canvas


def _region(photographs: Sequence[Image], size: int, rng: np.random.Generator) -> Image:
    photograph = photographs[rng.integers(len(photographs))]
    side = min(int(size * 2 ** rng.uniform(-0.3, 1.6)), min(photograph.shape[:2]))
    top, left = (int(rng.integers(0, extent - side + 1)) for extent in photograph.shape[:2])
    region = photograph[top : top + side, left : left + side]
    return cv2.resize(region, (size, size), interpolation=cv2.INTER_AREA if side > size else cv2.INTER_CUBIC)


def _pasted(canvas: Image, cutout: Image, rng: np.random.Generator) -> Image:
    size = canvas.shape[0]
    scale = size * rng.uniform(0.25, 0.8) / max(cutout.shape[:2])
    turn = cv2.getRotationMatrix2D((cutout.shape[1] / 2, cutout.shape[0] / 2), rng.uniform(-180, 180), scale)
    turn[:, 2] += rng.uniform(0.1, 0.9, 2) * size - np.array(cutout.shape[1::-1]) / 2
    reduced = cv2.GaussianBlur(cutout, (0, 0), 0.5 / scale) if scale < 0.7 else cutout
    layer = cv2.warpAffine(reduced, turn, (size, size)).astype(np.float32)
    alpha = layer[..., 3:] / 255
    return np.rint(canvas * (1 - alpha) + layer[..., :3] * alpha).astype(np.uint8)


def random_homography(size: int, rng: np.random.Generator, strength: float) -> Array:
    """``(3, 3)`` from one ``(size, size)`` image to another view of it: rotation, scale, shear, perspective, shift."""
    centre = (size - 1) / 2
    angle = np.radians(strength * rng.uniform(-60, 60))
    scale = 2.0 ** (strength * rng.uniform(-0.6, 0.6))
    tilt, stretch = rng.uniform(0, np.pi), 1 - strength * rng.uniform(0, 0.45)
    turn = _rotation(tilt) @ np.diag([1.0, stretch]) @ _rotation(-tilt)
    H = np.eye(3)
    H[:2, :2] = scale * _rotation(angle) @ turn
    H[2, :2] = strength * rng.uniform(-0.25, 0.25, 2) / centre
    H[:2, 2] = rng.uniform(-SHIFT, SHIFT, 2) * size
    shift = np.array([[1, 0, centre], [0, 1, centre], [0, 0, 1.0]])
    return shift @ H @ np.linalg.inv(shift)


def _rotation(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def apply_homography(H: Array, points: Array) -> Array:
    """Map ``(N, 2)`` points."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


def warped_pair(
    canvas: Image, fixed_points: Array, crop: int, size: int, rng: np.random.Generator, strength: float
) -> Pair:
    """The middle of a canvas, and the same under a homography, each under a light of its own.

    Args:
        canvas: ``(CANVAS * size, CANVAS * size, 3)``.
        fixed_points: ``(N, 2)`` points of the middle.
        crop: Index of the canvas.
        size: Side of the two images.
        rng: The source of all randomness.
        strength: Of all changes, from 0 to 1.
    """
    border = (canvas.shape[0] - size) // 2
    plain = canvas[border : border + size, border : border + size]
    H = random_homography(size, rng, strength)
    shift = np.array([[1, 0, -border], [0, 1, -border], [0, 0, 1.0]])
    other = cv2.warpPerspective(
        canvas, H @ shift, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    moved = apply_homography(H, fixed_points)
    seen = np.flatnonzero(((moved > 2) & (moved < size - 3)).all(1))
    images = disturb(plain, rng, 0.5 * strength), disturb(other, rng, strength)
    points = fixed_points[seen].astype(np.float32), moved[seen].astype(np.float32)
    return Pair(images, points, crop, seen)
