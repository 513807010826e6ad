"""SIFT keypoints with descriptors inside the mask, for matching surface points across large motions."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_MAX_KEYPOINTS = 250  # most keypoints of a frame
_CONTRAST = 0.02  # half of OpenCV's default, for the faint texture of small objects
_SIZE = 200  # length in pixels to which the object's longer side is scaled
_SMALLEST = (
    100  # pixels; the longer side is scaled up as if it had at least so many, and down by the same factor
)
_BORDER = 8  # pixels around the object that descriptors may use
_RATIO = 0.8  # ratio of the distances to the best and the second-best match, Lowe 2004, section 7.1
_SAME_CORNER = 2.0  # pixels within which keypoints are one corner, at several scales and orientations


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one frame. A corner with two orientations occurs twice, since either descriptor may match."""

    pixel: NDArray[np.float32]  # (M, 2) float32 in the full frame
    descriptor: NDArray[np.float32]  # (M, 128) float32

    @classmethod
    def none(cls) -> Keypoints:
        """No keypoints."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))

    def __len__(self) -> int:
        return len(self.pixel)


def detect(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    length: float | None = None,
    most: int = _MAX_KEYPOINTS,
    size: float = _SIZE,
    contrast: float = _CONTRAST,
) -> Keypoints:
    """The strongest keypoints inside a mask, with the object scaled to a fixed size.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)``.
        length: Longer side of the object in pixels, if the mask is not the object's.
        most: The most keypoints.
        size: Length in pixels to which the object's longer side is scaled.
        contrast: The least contrast of a keypoint, as OpenCV counts it.
    """
    if not mask.any():
        return Keypoints.none()
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    corner = np.array([max(x - _BORDER, 0), max(y - _BORDER, 0)])
    box = slice(corner[1], y + height + _BORDER), slice(corner[0], x + width + _BORDER)
    original = np.array(image[box].shape[::-1])
    scale = float(np.clip(size / (length or max(width, height)), _SMALLEST / size, size / _SMALLEST))
    # If the size is given instead of a factor, OpenCV scales by exactly the ratio of the sizes.
    scaled = np.rint(scale * original).astype(int).tolist()
    crop = cv2.resize(image[box], scaled, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    inside = cv2.resize(mask[box].astype(np.uint8), scaled, interpolation=cv2.INTER_NEAREST)
    # Without the precise upscale, all keypoints are a quarter of a pixel too far right and down.
    sift = cv2.SIFT.create(most, contrastThreshold=contrast, enable_precise_upscale=True)
    found, descriptor = sift.detectAndCompute(crop, inside)
    if not len(found):
        return Keypoints.none()
    place = np.array([point.pt for point in found])
    pixel = (place + 0.5) * original / scaled - 0.5 + corner
    return Keypoints(pixel.astype(np.float32), np.asarray(descriptor, dtype=np.float32))


def match(a: Keypoints, b: Keypoints, ratio: float = _RATIO) -> NDArray[np.int64]:
    """Mutual nearest neighbours that pass the ratio test against keypoints elsewhere in ``b``.

    Args:
        a: Keypoints of one frame.
        b: Those of another.
        ratio: The largest ratio of the distances to the match and to the nearest keypoint elsewhere.

    Returns:
        ``(K, 2)`` indices into ``a`` and ``b``, each at most once.
    """
    if not (len(a) and len(b)):
        return np.zeros((0, 2), np.int64)
    similarity = _root_sift(a.descriptor) @ _root_sift(b.descriptor).T
    distance = np.sqrt(np.maximum(2 - 2 * similarity, 0.0))
    best = distance.argmin(1)
    mutual = np.flatnonzero(distance.argmin(0)[best] == np.arange(len(a)))
    distance, best = distance[mutual], best[mutual]
    gap = np.abs(b.pixel[best][:, None] - b.pixel).max(2)
    elsewhere = np.where(gap < _SAME_CORNER, np.inf, distance).min(1)
    clear = np.isfinite(elsewhere) & (distance[np.arange(len(best)), best] < ratio * elsewhere)
    return np.stack([mutual[clear], best[clear]], 1)


def _root_sift(descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit vectors whose dot products are the Hellinger kernel (RootSIFT, Arandjelovic and Zisserman 2012)."""
    return np.asarray(np.sqrt(descriptor / descriptor.sum(1, keepdims=True).clip(1e-9)), dtype=np.float32)
