"""The mistakes that a tracker's mask has when it is carried into the next frame."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.float32]


def damaged(
    mask: Mask, image: NDArray[np.uint8], others: list[Mask], rng: np.random.Generator, strength: float
) -> Mask:
    """A mask with up to three mistakes.

    Args:
        mask: ``(S, S)`` in [0, 1], the truth.
        image: ``(S, S, 3)`` RGB.
        others: ``(S, S)`` masks of what may be taken for the object: a hand, a shadow.
        rng: Random numbers.
        strength: 0 for none to 1.
    """
    size = float(np.sqrt(max(np.count_nonzero(mask > 0.5), 1)))
    result = mask.copy()
    kinds = rng.choice(
        ["rim", "shift", "colour part", "cut", "leak", "other", "ragged", "hole"],
        size=int(rng.integers(0, 4)),
        replace=False,
        p=[0.22, 0.14, 0.14, 0.12, 0.12, 0.12, 0.09, 0.05],
    )
    for kind in kinds:
        amount = strength * rng.uniform(0.2, 1)
        if kind == "rim":
            result = _rim(result, 0.12 * size * amount, rng)
        elif kind == "shift":
            right, down = rng.normal(0, 0.08 * size * amount, 2)
            result = _shift(result, right, down)
        elif kind == "colour part":
            result = result * (1 - _like_a_pixel(image, result, rng) * (result > 0.5))
        elif kind == "cut":
            result = result * _half_plane(result, amount, rng)
        elif kind == "leak":
            result = np.maximum(result, _leak(image, result, size, amount, rng))
        elif kind == "other" and others:
            result = np.maximum(result, others[int(rng.integers(len(others)))])
        elif kind == "ragged":
            result = _ragged(result, 0.15 * size * amount, rng)
        elif kind == "hole":
            result = _hole(result, size * amount, rng)
    kept = result if np.count_nonzero(result > 0.5) > 0.15 * size**2 else mask
    return np.ascontiguousarray(kept, np.float32)


def _disc(radius: float) -> NDArray[np.uint8]:
    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def _rim(mask: Mask, radius: float, rng: np.random.Generator) -> Mask:
    change = cv2.dilate if rng.random() < 0.55 else cv2.erode
    return change(mask, _disc(radius))


def _shift(mask: Mask, right: float, down: float) -> Mask:
    return cv2.warpAffine(mask, np.array([[1, 0, right], [0, 1, down]], np.float32), mask.shape[::-1])


def _pixel_of(mask: Mask, rng: np.random.Generator) -> tuple[int, int] | None:
    rows, columns = np.nonzero(mask > 0.5)
    if not len(rows):
        return None
    index = int(rng.integers(len(rows)))
    return int(rows[index]), int(columns[index])


def _like_a_pixel(image: NDArray[np.uint8], mask: Mask, rng: np.random.Generator) -> Mask:
    """What has the colour of one of the object's pixels: trackers lose whole parts of a colour."""
    pixel = _pixel_of(mask, rng)
    if pixel is None:
        return np.zeros_like(mask)
    colours = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2LAB), (5, 5), 0).astype(np.float32)
    distance = np.linalg.norm(colours - colours[pixel], axis=2)
    near = (distance < rng.uniform(12, 35)).astype(np.float32)
    return cv2.medianBlur((255 * near).astype(np.uint8), 5).astype(np.float32) / 255


def _half_plane(mask: Mask, amount: float, rng: np.random.Generator) -> Mask:
    rows, columns = np.nonzero(mask > 0.5)
    if not len(rows):
        return np.ones_like(mask)
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * columns + np.sin(angle) * rows
    threshold = np.quantile(along, 1 - 0.5 * amount)
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    return (np.cos(angle) * x + np.sin(angle) * y < threshold).astype(np.float32)


def _leak(image: NDArray[np.uint8], mask: Mask, size: float, amount: float, rng: np.random.Generator) -> Mask:
    """What beside the object has the colour of a pixel just beyond its outline."""
    rim = cv2.dilate(mask, _disc(0.08 * size)) * (mask < 0.5)
    near = cv2.dilate(mask, _disc(0.5 * size * amount + 2))
    return _like_a_pixel(image, rim, rng) * near


def _ragged(mask: Mask, reach: float, rng: np.random.Generator) -> Mask:
    side = mask.shape[0]
    coarse = rng.normal(0, 1, (2, max(side // 12, 2), max(side // 12, 2))).astype(np.float32)
    shift = np.stack([cv2.resize(field, (side, side), interpolation=cv2.INTER_CUBIC) for field in coarse])
    y, x = np.mgrid[:side, :side].astype(np.float32)
    return cv2.remap(mask, x + reach * shift[0], y + reach * shift[1], cv2.INTER_LINEAR)


def _hole(mask: Mask, reach: float, rng: np.random.Generator) -> Mask:
    pixel = _pixel_of(mask, rng)
    if pixel is None:
        return mask
    hole = np.zeros_like(mask)
    axes = tuple(int(max(reach * value, 2)) for value in rng.uniform(0.08, 0.35, 2))
    cv2.ellipse(hole, pixel[::-1], axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
    return mask * (1 - hole)
