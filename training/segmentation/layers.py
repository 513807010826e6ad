"""Layers of a composed frame: pictures with an alpha channel, moved and pasted on each other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Map = NDArray[np.float32]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """How much things change from one frame to another.

    Attributes:
        shift: Standard deviation of the translation, in pixels.
        turn: Of the rotation in the image, in degrees.
        scale: Of the logarithm of the scale.
        bend: Of the stretch, shear and perspective, as shares.
    """

    shift: float
    turn: float
    scale: float
    bend: float

    def draw(self, centre: tuple[float, float], rng: np.random.Generator) -> Matrix:
        """A random homography ``(3, 3)`` about ``centre`` (x, y)."""
        angle = np.radians(rng.normal(0, self.turn))
        scale = np.exp(rng.normal(0, self.scale))
        turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        matrix = np.eye(3)
        matrix[:2, :2] = turn @ (np.eye(2) + rng.normal(0, self.bend, (2, 2)))
        matrix[2, :2] = rng.normal(0, 0.3 * self.bend / 100, 2)
        return translation(*rng.normal(0, self.shift, 2)) @ about(centre, matrix)


def translation(right: float, down: float) -> Matrix:
    """``(3, 3)``."""
    return np.array([[1, 0, right], [0, 1, down], [0, 0, 1]], float)


def about(centre: tuple[float, float], matrix: Matrix) -> Matrix:
    """``matrix`` with ``centre`` (x, y) in place of the origin."""
    return translation(*centre) @ matrix @ translation(-centre[0], -centre[1])


def placed(cutout: Image, longest: float, centre: tuple[float, float], turn: float, mirrored: bool) -> Matrix:
    """The homography that puts a cut-out ``(h, w, 4)`` into a frame, its longer side ``longest`` pixels."""
    height, width = cutout.shape[:2]
    scale = longest / max(height, width)
    angle = np.radians(turn)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = np.eye(3)
    matrix[:2, :2] = linear @ np.diag([-1.0 if mirrored else 1.0, 1.0])
    return translation(*centre) @ matrix @ translation(-width / 2, -height / 2)


def warp(layer: Image, matrix: Matrix, side: int, border: int = cv2.BORDER_CONSTANT) -> Image:
    """A layer in a frame of ``side`` pixels, not aliased where it gets smaller."""
    scale = np.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    if scale < 0.6:
        layer = cv2.resize(layer, None, fx=1.5 * scale, fy=1.5 * scale, interpolation=cv2.INTER_AREA)
        matrix = matrix @ np.diag([1 / (1.5 * scale), 1 / (1.5 * scale), 1])
    return cv2.warpPerspective(layer, matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=border)


def alpha_of(layer: Image) -> Map:
    """``(S, S)`` in [0, 1]."""
    return layer[..., 3].astype(np.float32) / 255


def paste(frame: NDArray[np.float32], layer: Image, shade: Map | float = 1.0) -> NDArray[np.float32]:
    """``frame`` ``(S, S, 3)`` with a layer over it, its brightness times ``shade``."""
    alpha = alpha_of(layer)[..., None]
    colours = layer[..., :3].astype(np.float32)
    return frame * (1 - alpha) + alpha * colours * (
        shade[..., None] if isinstance(shade, np.ndarray) else shade
    )


def smeared(layer: Image, right: float, down: float) -> Image:
    """A layer blurred along a motion during the exposure, in pixels."""
    length = float(np.hypot(right, down))
    if length < 1.2:
        return layer
    side = 2 * int(np.ceil(length / 2)) + 1
    kernel = np.zeros((side, side), np.float32)
    middle, reach = (side - 1) / 2, np.array([right, down]) / 2
    ends = [tuple(round(v) for v in middle + sign * reach) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0)
    premultiplied = layer.astype(np.float32)
    premultiplied[..., :3] *= alpha_of(layer)[..., None]
    blurred = cv2.filter2D(premultiplied, -1, kernel / kernel.sum())
    blurred[..., :3] /= np.maximum(blurred[..., 3:] / 255, 1e-3)
    return np.clip(blurred, 0, 255).astype(np.uint8)


def shadow_of(alpha: Map, right: float, down: float, softness: float, darkness: float) -> Map:
    """``(S, S)`` factors of the brightness under a shadow that a shape casts."""
    matrix = np.array([[1, 0, right], [0, 1, down]], np.float32)
    moved = cv2.warpAffine(alpha, matrix, alpha.shape[::-1])
    return 1 - darkness * cv2.GaussianBlur(moved, (0, 0), max(softness, 0.5))
