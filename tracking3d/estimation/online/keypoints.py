"""Keypoints with descriptors, for finding surface points again after large motions: SIFT inside the mask."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MOST_KEYPOINTS = 250
_CONTRAST = 0.02  # half of OpenCV's: the faint texture of small objects counts
_RATIO = 0.8  # of the distances to the best and the second best, Lowe 2004, section 7.1
_SIZE = 200  # pixels that the longer side of the object is enlarged to, at most twice


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one frame.

    Attributes:
        pixel: ``(M, 2)`` float32 in the full frame.
        descriptor: ``(M, 128)`` float32.
    """

    pixel: NDArray[np.float32]
    descriptor: NDArray[np.float32]

    @classmethod
    def none(cls) -> Keypoints:
        """No keypoints."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))

    def __len__(self) -> int:
        return len(self.pixel)


def detect(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> Keypoints:
    """The strongest keypoints inside a mask.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)``.
    """
    if not mask.any():
        return Keypoints.none()
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    border = 8
    left, top = max(x - border, 0), max(y - border, 0)
    box = slice(top, y + height + border), slice(left, x + width + border)
    scale = min(max(_SIZE / max(width, height), 0.5), 2.0)
    size = None
    crop = cv2.resize(image[box], size, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    inside = cv2.resize(
        mask[box].astype(np.uint8) * 255, crop.shape[::-1], interpolation=cv2.INTER_NEAREST
    )
    sift = cv2.SIFT_create(MOST_KEYPOINTS, contrastThreshold=_CONTRAST)
    found, descriptors = sift.detectAndCompute(crop, inside)
    if descriptors is None or not len(found):
        return Keypoints.none()
    actual = np.array([crop.shape[1] / image[box].shape[1], crop.shape[0] / image[box].shape[0]])
    pixel = (np.array([point.pt for point in found]) + 0.5) / actual - 0.5 + [left, top]
    # A corner with two orientations is there twice; both descriptors may match.
    return Keypoints(pixel.astype(np.float32), np.asarray(descriptors, dtype=np.float32))


def match(a: Keypoints, b: Keypoints) -> NDArray[np.int64]:
    """``(K, 2)`` indices into ``a`` and ``b`` of keypoints that are each other's nearest and clearly so."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = _rooted(a.descriptor) @ _rooted(b.descriptor).T
    distance = np.sqrt(np.maximum(2 - 2 * similarity, 0.0))
    rows = np.arange(len(a))
    best = distance.argmin(1)
    nearest = distance[rows, best]
    others = distance.copy()
    # Neighbours at the same place do not make a match doubtful.
    same = np.abs(b.pixel[None, :] - b.pixel[best][:, None]).max(2) < 2
    others[same] = np.inf
    clear = nearest < _RATIO * others.min(1)
    mutual = distance.argmin(0)[best] == rows
    kept = np.flatnonzero(clear & mutual)
    return np.stack([kept, best[kept]], 1)


def _rooted(descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit vectors whose products are Hellinger's kernel (RootSIFT, Arandjelovic and Zisserman 2012)."""
    return np.asarray(np.sqrt(descriptor / descriptor.sum(1, keepdims=True).clip(1e-9)), dtype=np.float32)
