"""Keypoints with descriptors inside the mask, for matching surface points across large motions; by SIFT at first."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from tracking3d.features.protocol import KeypointDetector as Detector
from tracking3d.features.protocol import Keypoints as Keypoints

_MAX_KEYPOINTS = 250  # most keypoints of a frame
_CONTRAST = 0.02  # half of OpenCV's default, for the faint texture of small objects
_SIZE = 200  # length in pixels to which the object's longer side is scaled
# Pixels; the longer side is scaled up as if it had at least so many, and down by the same factor
_SMALLEST = 100
_BORDER = 8  # pixels around the object that descriptors may use
_SAME_CORNER = 2.0  # pixels within which keypoints are one corner, at several scales and orientations
_TURNS: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)  # degrees, where nothing tells which way is up


class SiftDetector:
    """Keypoint detector ``sift`` (Lowe 2004); implements `tracking3d.features.protocol.KeypointDetector`."""

    rotation_invariant = True

    class Options(BaseModel):
        """SIFT has no options."""

        model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build it."""
        return cls()

    def detect(
        self, image: NDArray[np.uint8], mask: NDArray[np.bool_], most: int, contrast: float
    ) -> Keypoints:
        """The strongest keypoints inside a mask; compared as RootSIFT, with the ratio of Lowe 2004, section 7.1."""
        # Without the precise upscale, all keypoints are a quarter of a pixel too far right and down.
        sift = cv2.SIFT.create(most, contrastThreshold=contrast * _CONTRAST, enable_precise_upscale=True)
        found, descriptor = sift.detectAndCompute(image, mask.view(np.uint8))
        if not len(found):
            return Keypoints.none()
        place = np.array([point.pt for point in found])  # `detect` rounds pixels, once
        return Keypoints(place, np.asarray(descriptor, dtype=np.float32))


SIFT = SiftDetector()


def detect(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    length: float | None = None,
    most: int = _MAX_KEYPOINTS,
    size: float = _SIZE,
    contrast: float = 1.0,
    detector: Detector = SIFT,
    turn: float = 0.0,
) -> Keypoints:
    """The strongest keypoints inside a mask, with the object scaled to a fixed size.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)``.
        length: Longer side of the object in pixels, if the mask is not the object's.
        most: The most keypoints.
        size: Length in pixels to which the object's longer side is scaled.
        contrast: The least contrast of a keypoint, over the usual one.
        detector: What finds and describes them.
        turn: Degrees by which the picture is turned clockwise first, if the detector is not rotation invariant.
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
    back = np.eye(2, 3)
    if turn and not detector.rotation_invariant:
        crop, inside, back = _turned(crop, inside, turn)
    found = detector.detect(crop, inside.view(np.bool_), most, contrast)
    if not len(found):
        return Keypoints.none()
    place = found.pixel @ back[:, :2].T + back[:, 2] if turn else found.pixel
    pixel = (place + 0.5) * original / scaled - 0.5 + corner
    return replace(found, pixel=pixel.astype(np.float32))


def _turned(
    crop: NDArray[np.uint8], inside: NDArray[np.uint8], degrees: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]:
    """A crop and its mask turned clockwise, and ``(2, 3)`` from pixels of the turned one to its own."""
    height, width = crop.shape
    turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), -degrees, 1.0)
    size = np.ceil(np.abs(turn[:, :2]) @ [width, height] - 1e-6).astype(int)
    turn[:, 2] += (size - [width, height]) / 2
    turned = cv2.warpAffine(crop, turn, size.tolist(), borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)
    mask = cv2.warpAffine(inside, turn, size.tolist(), flags=cv2.INTER_NEAREST).astype(np.uint8)
    return turned, mask, cv2.invertAffineTransform(turn)


def detect_turned(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    detector: Detector,
    R: NDArray[np.float64] | None = None,
    **how: Any,
) -> tuple[Keypoints, ...]:
    """`detect` with the object upright; in each of four turns if nothing tells which way is up.

    Upright means that the object's second axis points down, as in the frame that its axes come from.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)``.
        detector: What finds and describes them; one that is rotation invariant is asked once.
        R: ``(3, 3)`` from the object to the camera; None if it is not known.
        **how: As in `detect`.
    """
    turns = _TURNS[:1] if detector.rotation_invariant else _TURNS
    if R is not None:
        turns = (float(np.degrees(np.arctan2(R[0, 1], R[1, 1]))),)
    return tuple(detect(image, mask, detector=detector, turn=turn, **how) for turn in turns)


def match(a: Keypoints, b: Keypoints, looser: float = 1.0) -> NDArray[np.int64]:
    """Mutual nearest neighbours that pass the ratio test against keypoints elsewhere in ``b``.

    Args:
        a: Keypoints of one frame.
        b: Those of another.
        looser: Factor on how far the ratio of the distances to the match and to the nearest keypoint elsewhere must
            stay below 1.

    Returns:
        ``(K, 2)`` indices into ``a`` and ``b``, each at most once.
    """
    if not (len(a) and len(b)):
        return np.zeros((0, 2), np.int64)
    unit = _root_sift if a.similarity == "hellinger" else _unit_vectors
    similarity = unit(a.descriptor) @ unit(b.descriptor).T
    distance = np.sqrt(np.maximum(2 - 2 * similarity, 0.0))
    best = distance.argmin(1)
    mutual = np.flatnonzero(distance.argmin(0)[best] == np.arange(len(a)))
    distance, best = distance[mutual], best[mutual]
    gap = np.abs(b.pixel[best][:, None] - b.pixel).max(2)
    elsewhere = np.where(gap < _SAME_CORNER, np.inf, distance).min(1)
    clear = np.isfinite(elsewhere) & (
        distance[np.arange(len(best)), best] < (1 - looser * (1 - a.ratio)) * elsewhere
    )
    return np.stack([mutual[clear], best[clear]], 1)


def _root_sift(descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit vectors whose dot products are the Hellinger kernel (RootSIFT, Arandjelovic and Zisserman 2012)."""
    return np.asarray(np.sqrt(descriptor / descriptor.sum(1, keepdims=True).clip(1e-9)), dtype=np.float32)


def _unit_vectors(descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
    return descriptor / np.linalg.norm(descriptor, axis=1, keepdims=True).clip(1e-9)
