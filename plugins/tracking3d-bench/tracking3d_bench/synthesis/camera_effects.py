"""Camera effects from light at the sensor to an 8-bit image: contrast, noise, encoding.

Encoding is a plain power law of 2.2, which is near sRGB's.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.synthesis.spec import Disturbances

GAMMA = 2.2

_MIDDLE = 0.45  # encoded grey that low contrast shrinks towards


def linear(encoded: ArrayLike) -> NDArray[np.float32]:
    """Linear light of encoded values in [0, 255]."""
    return np.power(np.asarray(encoded, np.float32) / 255, GAMMA, dtype=np.float32)


def expose(
    light: NDArray[np.float32], disturbances: Disturbances, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The image ``(H, W, 3)`` uint8 of linear light ``(H, W, 3)``.

    Noise has a part that grows with the root of the light, as photons have, and a constant one.
    """
    values = np.clip(light, 0, 1) ** np.float32(1 / GAMMA)
    values = _MIDDLE + (1 - 0.8 * disturbances.low_contrast) * (values - _MIDDLE)
    if disturbances.noise > 0:
        spread = disturbances.noise * (0.05 + 0.05 * np.sqrt(values))
        values = values + spread * rng.standard_normal(values.shape, dtype=np.float32)
    image: NDArray[np.uint8] = np.clip((255 * values).round(), 0, 255).astype(np.uint8)
    return image


def jpeg_quality(strength: float) -> int:
    """Quality of JPEG compression of a strength in (0, 1]."""
    return round(95 - 80 * strength)


def compress(image: NDArray[np.uint8], strength: float) -> bytes:
    """The JPEG file of an image ``(H, W, 3)``."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality(strength)]
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), quality)[1])
