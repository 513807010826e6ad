"""Grey images with known texture and known motion."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def speckle(size: tuple[int, int] = (200, 240), blur: float = 2.0, seed: int = 0) -> Image:
    """``(H, W)`` random texture without repetition, smooth over ``blur`` pixels."""
    noise = np.random.default_rng(seed).normal(size=size)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur)
    return as_grey(128 + 40 * smooth / smooth.std())


def warped(image: Image, matrix: NDArray[np.float64]) -> Image:
    """``image`` moved by an affine ``(2, 3)`` that takes old pixels to new ones; its border goes on outside."""
    return cv2.warpAffine(
        image, matrix, image.shape[::-1], flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT
    )


def shift(x: float, y: float) -> NDArray[np.float64]:
    """``(2, 3)`` translation."""
    return np.array([[1.0, 0, x], [0, 1.0, y]])


def moved(pixel: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels ``(N, 2)`` under an affine ``(2, 3)``."""
    return pixel @ matrix[:, :2].T + matrix[:, 2]


def disc(size: tuple[int, int], centre: tuple[float, float], radius: float) -> NDArray[np.bool_]:
    """``(H, W)`` mask of a disc around ``(x, y)``."""
    y, x = np.mgrid[: size[0], : size[1]]
    return np.asarray((x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2)


def as_grey(values: NDArray[np.float64]) -> Image:
    """Rounded and cut off at 0 and 255."""
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)
