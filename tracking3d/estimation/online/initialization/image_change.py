"""How the image of an object has changed between two frames, apart from what a shaking camera does to it.

A camera in a hand moves the image of a still object, turns it about the line of sight and changes its size. Whatever is
left after this similarity is taken away shows that the object turns, or that something covers it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.observation import Observation

_BLUR = 0.016  # standard deviation, relative to the crop's side, with which masks are aligned
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-4)
_INSIDE = 0.9  # value of a mask from which a pixel is compared
_MARGIN = 5  # pixels from the outline at which pixels are compared

Image = NDArray[np.float32]


@dataclass(frozen=True)
class ImageChange:
    """A change between two frames."""

    outline: float  # 1 - IoU of the aligned masks
    shading: float  # mean absolute difference of the aligned grey images inside both masks, in [0, 1]


def image_change(first: Observation, second: Observation) -> ImageChange:
    """The change from one observation of an object to another, both with a mask, as the masks' similarity leaves it."""
    mask_a, mask_b = (np.ascontiguousarray(one.mask.cpu().numpy(), np.float32) for one in (first, second))
    if not mask_a.any() or not mask_b.any():
        return ImageChange(0.0, 0.0)
    grey_a, grey_b = (_grey(one) for one in (first, second))
    similarity = _similarity(mask_a, mask_b)

    def warped(image: Image) -> Image:
        size = (mask_a.shape[1], mask_a.shape[0])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(image, similarity, size, flags=flags), np.float32)

    mask_b, grey_b = warped(mask_b), warped(grey_b)
    outline = 1 - float(np.minimum(mask_a, mask_b).sum() / np.maximum(mask_a, mask_b).sum())
    both = ((mask_a > _INSIDE) & (mask_b > _INSIDE)).astype(np.uint8)
    inside = cv2.erode(both, np.ones((_MARGIN, _MARGIN), np.uint8)) > 0
    shading = float(np.abs(grey_a - grey_b)[inside].mean()) if inside.any() else 0.0
    return ImageChange(outline, shading)


def _grey(observation: Observation) -> Image:
    side = observation.mask.shape[-1]
    grey = np.ascontiguousarray(observation.image.mean(0).cpu().numpy(), np.float32)
    return np.asarray(cv2.resize(grey, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def _similarity(first: Image, second: Image) -> NDArray[np.float32]:
    """``(2, 3)`` from pixels of one mask to the other's: sizes and centres agree, then it is turned to overlap best."""
    (x_a, y_a), (x_b, y_b) = (_centre(mask) for mask in (first, second))
    scale = float(np.sqrt(second.sum() / first.sum()))
    placed = np.array([[scale, 0, x_b - scale * x_a], [0, scale, y_b - scale * y_a], [0, 0, 1]])
    blur = _BLUR * first.shape[0]
    a, b = (cv2.GaussianBlur(mask, (0, 0), blur) for mask in (first, second))
    size = (first.shape[1], first.shape[0])
    b = cv2.warpAffine(b, placed[:2], size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    turn = np.eye(3)
    try:
        _, found = cv2.findTransformECC(a, b, np.eye(2, 3, dtype=np.float32), cv2.MOTION_EUCLIDEAN, _STOP)
        turn[:2] = found
    except cv2.error:  # the masks have nothing in common that could be turned
        pass
    return np.asarray((placed @ turn)[:2], np.float32)


def _centre(mask: Image) -> tuple[float, float]:
    moments = cv2.moments(mask)
    return moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
