"""What a camera and the light do to a frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Float = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera's look, the same in all frames of a sequence.

    Attributes:
        gains: Factors of red, green and blue.
        gamma: Exponent of the brightness.
        blur: Standard deviation of the lens' blur in pixels.
        noise: Standard deviation of the grey values.
        quality: Of JPEG compression; 0 for none.
    """

    gains: tuple[float, float, float]
    gamma: float
    blur: float
    noise: float
    quality: int

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Camera:
        """A random one."""
        red, blue = np.exp(rng.normal(0, 0.08, 2))
        exposure = np.exp(rng.normal(0, 0.15))
        return cls(
            gains=(exposure * red, exposure, exposure * blue),
            gamma=float(np.exp(rng.normal(0, 0.15))),
            blur=float(rng.choice([0.0, rng.uniform(0.3, 1.4)])),
            noise=float(rng.choice([0.0, rng.uniform(0, 6)])),
            quality=int(rng.choice([0, rng.integers(35, 95)])),
        )

    def take(self, frame: Float, rng: np.random.Generator, change: float = 0.02) -> Image:
        """A picture of ``frame`` ``(S, S, 3)`` in 0 to 255; its exposure differs by ``change`` from frame to frame."""
        gains = np.array(self.gains, np.float32) * np.float32(np.exp(rng.normal(0, change)))
        picture = 255 * np.power(np.clip(frame * gains / 255, 0, 1), self.gamma)
        if self.blur > 0.3:
            picture = cv2.GaussianBlur(picture, (0, 0), self.blur)
        if self.noise:
            picture = picture + rng.normal(0, self.noise, picture.shape)
        picture = np.clip(picture, 0, 255).astype(np.uint8)
        if self.quality:
            _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
            picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
        return picture


def plain_backdrop(side: int, rng: np.random.Generator) -> Image:
    """``(side, side, 3)`` RGB: cloth or paper behind a thing, mostly black, grey or white, as on a turntable."""
    grey = float(
        rng.choice([rng.uniform(0, 30), rng.uniform(30, 200), rng.uniform(200, 255)], p=[0.45, 0.25, 0.3])
    )
    colour = np.full(3, grey) if rng.random() < 0.7 else grey + rng.normal(0, 45, 3)
    light = light_over(side, rng, float(rng.choice([0.0, 0.1, 0.3])))
    if rng.random() < 0.3:  # the edge of the table
        edge = int(rng.uniform(0.4, 0.9) * side)
        light[edge:] *= rng.uniform(0.7, 1.3)
    cloth = cv2.GaussianBlur(rng.normal(0, 1, (side, side)).astype(np.float32), (0, 0), rng.uniform(1, 20))
    cloth *= rng.uniform(0, 5) / max(float(cloth.std()), 1e-6)
    return np.clip(colour * light[..., None] + cloth[..., None], 0, 255).astype(np.uint8)


def light_over(side: int, rng: np.random.Generator, strength: float) -> Float:
    """``(side, side)`` smooth factors of the brightness: a lamp to one side."""
    direction = rng.normal(0, strength, 2)
    y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    return np.clip(1 + direction[0] * x + direction[1] * y, 0.3, 1.8).astype(np.float32)
