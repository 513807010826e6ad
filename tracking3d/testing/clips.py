"""Short clips that trackers are checked on: a textured disc that moves over a textured background."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Frame, Prompt
from tracking3d.trackers.crops import box_of

Size = tuple[int, int]
"""``(height, width)`` in pixels."""


@dataclass(frozen=True, eq=False)
class Clip:
    """Frames with the true mask ``(H, W)`` bool of the first."""

    frames: tuple[Frame, ...]
    mask: NDArray[np.bool_]

    @property
    def box(self) -> Box:
        """The box around the mask."""
        box = box_of(self.mask)
        assert box is not None
        return box

    def prompt(self, with_mask: bool) -> Prompt:
        """The object in the first frame, with its mask or with a box alone."""
        return Prompt(self.box, self.mask.copy() if with_mask else None)


def moving_disc(size: Size, count: int, seed: int = 0) -> Clip:
    """A warm disc that drifts two pixels a frame over a cool background.

    Args:
        size: Of the frames.
        count: Number of frames.
        seed: Other seeds give other textures and another way.
    """
    height, width = size
    random = np.random.default_rng(seed)
    background = _texture(random, size, (20, 60, 90), (90, 150, 220))
    surface = _texture(random, size, (150, 60, 10), (250, 150, 60))
    radius = min(size) // 5
    shift = -2 if seed % 2 else 2
    rows, columns = np.mgrid[:height, :width]
    frames, masks = [], []
    for index in range(count):
        centre = width // 2 - shift * count // 2 + shift * index
        mask = (rows - height // 2) ** 2 + (columns - centre) ** 2 < radius**2
        shifted = np.roll(surface, shift * index, axis=1)
        image = np.where(mask[..., None], shifted, background)
        frames.append(Frame(index, image, index / 10, f"frame {index}"))
        masks.append(mask)
    return Clip(tuple(frames), masks[0])


def plain_frames(size: Size, grey: int, count: int) -> tuple[Frame, ...]:
    """Frames of one grey value, such as a covered or a dazzled camera gives."""
    return tuple(
        Frame(index, np.full((*size, 3), grey, np.uint8), index / 10, f"frame {index}")
        for index in range(count)
    )


def _texture(
    random: np.random.Generator, size: Size, low: tuple[int, int, int], high: tuple[int, int, int]
) -> NDArray[np.uint8]:
    noise = cv2.GaussianBlur(random.random((*size, 3)), (0, 0), 1.5)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return (np.array(low) + noise * (np.array(high) - np.array(low))).round().astype(np.uint8)
