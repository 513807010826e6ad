"""The mask that a frame is answered with: rendered, initial, or what both agree on."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.judgement import Usual

_ALIKE = 0.85  # IoU of two masks that differ along their outlines only
_ODD = 0.85  # share of the usual overlap below which a frame's initial mask stands out
_SOUND_SHAPE = 0.75  # usual overlap below which it is the shape that is wrong
_DISTRUSTED = 0.5  # weight of an initial mask that points contradict
_RENDERED_SHARE = 0.6  # of the rendered outline in the mean of both
_REACH = 0.06  # of the root of the area: how far an outline pulls


def answer_mask(
    rendered: NDArray[np.bool_],
    initial: NDArray[np.bool_] | None,
    usual: Usual,
    mask_weight: float,
    witnesses: bool,
) -> NDArray[np.bool_]:
    """The better supported of two masks ``(H, W)``, or the mean of their outlines where they are alike.

    Args:
        rendered: The silhouette at the frame's pose.
        initial: The mask tracker's, or None.
        usual: How well the two overlap usually.
        mask_weight: How far the points believe the initial mask.
        witnesses: Whether points enough settle the pose.
    """
    if initial is None:
        return rendered
    overlap = float((rendered & initial).sum()) / max(float((rendered | initial).sum()), 1.0)
    if overlap >= _ALIKE:
        return _mean_outline(rendered, initial)
    trusted = usual.overlap >= _SOUND_SHAPE and witnesses
    stands_out = overlap < _ODD * usual.overlap
    if trusted and (stands_out or mask_weight < _DISTRUSTED):
        return rendered
    return _mean_outline(rendered, initial) if trusted else initial


def _mean_outline(rendered: NDArray[np.bool_], initial: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Where the weighted mean of both signed distances, each cut off at `_REACH`, is inside."""
    reach = _REACH * float(np.sqrt(initial.sum()))

    def distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        inside = mask.astype(np.uint8)
        outward = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_5)
        inward = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5)
        return np.asarray(np.clip(outward - inward, -reach, reach), dtype=np.float32)

    mean = _RENDERED_SHARE * distance(rendered) + (1 - _RENDERED_SHARE) * distance(initial)
    return np.asarray(mean < 0)
