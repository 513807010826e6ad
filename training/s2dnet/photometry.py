"""Strong photometric changes, all from one random generator: what a description should not depend on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
"""``(H, W, 3)`` RGB in [0, 1]."""


def disturb(image: NDArray[np.uint8], rng: np.random.Generator, strength: float) -> FloatImage:
    """Change light, colour, exposure and sharpness of ``image`` ``(H, W, 3)``.

    Args:
        image: RGB.
        rng: The source of all randomness.
        strength: 1 for the whole range, 0 for nothing at all.

    Returns:
        RGB in [0, 1].
    """
    light = (image.astype(np.float32) / 255) ** 2.2
    height, width = light.shape[:2]
    light *= np.exp(strength * rng.uniform(-0.7, 0.7) + strength * rng.uniform(-0.3, 0.3, 3)).astype(
        np.float32
    )
    if rng.random() < 0.8:
        light *= _shading(height, width, rng, strength)[..., None]
    if rng.random() < 0.4 * strength:
        light *= _cast_shadow(height, width, rng, strength)[..., None]
    if rng.random() < 0.5 * strength:
        light += _highlights(height, width, rng)[..., None] * rng.uniform(0.6, 1, 3).astype(np.float32)
    picture = np.clip(light, 0, 1) ** np.float32(2.0 ** rng.uniform(-strength, strength) / 2.2)
    contrast = 1 - strength * rng.uniform(0, 0.6)
    picture = contrast * picture + (1 - contrast) * rng.random(dtype=np.float32)
    picture = _blurred(picture, rng, strength)
    picture = picture + np.float32(strength * rng.uniform(0, 0.05)) * rng.standard_normal(
        picture.shape, dtype=np.float32
    )
    picture = np.clip(picture, 0, 1)
    if rng.random() < 0.4 * strength:
        quality = int(rng.integers(25, 95))
        _, data = cv2.imencode(
            ".jpg", np.rint(255 * picture).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
        )
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR).astype(np.float32) / 255
    if rng.random() < 0.1 * strength:
        picture = np.repeat(picture.mean(2, keepdims=True), 3, axis=2)
    return picture.astype(np.float32)


def _shading(height: int, width: int, rng: np.random.Generator, strength: float) -> FloatImage:
    """A ramp in a random direction, and slow variations."""
    rows, columns = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
    angle = rng.uniform(0, 2 * np.pi)
    ramp = rng.uniform(0, 1.2) * (np.cos(angle) * columns + np.sin(angle) * rows)
    cells = int(rng.integers(2, 6))
    slow = cv2.resize(
        rng.standard_normal((cells, cells), dtype=np.float32), (width, height), interpolation=cv2.INTER_CUBIC
    )
    return np.exp(strength * (ramp + rng.uniform(0, 0.4) * slow)).astype(np.float32)


def _cast_shadow(height: int, width: int, rng: np.random.Generator, strength: float) -> FloatImage:
    """A dark polygon with a soft edge."""
    corners = (rng.random((4, 2)) * 1.6 - 0.3) * (width, height)
    mask = cv2.fillPoly(np.zeros((height, width), np.float32), [corners.astype(np.int32)], 1.0)
    mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.5, 8))
    return 1 - np.float32(strength * rng.uniform(0.3, 0.8)) * mask


def _highlights(height: int, width: int, rng: np.random.Generator) -> FloatImage:
    """A few glossy spots."""
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    spots = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(1, 4))):
        x, y, radius = rng.uniform(0, width), rng.uniform(0, height), rng.uniform(0.03, 0.2) * width
        stretch, angle = rng.uniform(0.3, 1), rng.uniform(0, np.pi)
        across = (columns - x) * np.cos(angle) + (rows - y) * np.sin(angle)
        along = (rows - y) * np.cos(angle) - (columns - x) * np.sin(angle)
        spots += rng.uniform(0.2, 1.2) * np.exp(-(across**2 + (along / stretch) ** 2) / (2 * radius**2))
    return spots


def _blurred(picture: FloatImage, rng: np.random.Generator, strength: float) -> FloatImage:
    if rng.random() < 0.5 * strength:
        picture = cv2.GaussianBlur(picture, (0, 0), rng.uniform(0.3, 1.6))
    if rng.random() < 0.2 * strength:
        length = int(rng.integers(3, 9))
        kernel = np.zeros((length, length), np.float32)
        turn = cv2.getRotationMatrix2D(((length - 1) / 2,) * 2, rng.uniform(0, 180), 1)
        kernel[length // 2] = 1
        kernel = cv2.warpAffine(kernel, turn, (length, length))
        picture = cv2.filter2D(picture, -1, kernel / max(kernel.sum(), 1e-3))
    return picture
