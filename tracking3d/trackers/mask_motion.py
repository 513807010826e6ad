"""The motion of the last mask, by dense optical flow and a similarity, and the pixels consistent with it.

Everything is in the pixels of two equally large crops, the last frame's and the present one's.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_ROUND_TRIP = 1.5
"""Flow is trusted where forward and backward flow cancel to within this many pixels."""

_STRIDE = 3  # models of motion are fitted on every third pixel: enough, and nine times cheaper
_LEAST = 12  # pixels that a model is fitted on
_AGREEING = 1.5  # pixels
_LAST_ROW = (0.0, 0.0, 1.0)
_STILL = 0.5  # pixels within which pixels have to be where a background that stands still has them
_MORE = 1.1
"""Times as many pixels have to agree with a homography as with a similarity. A floor that a camera walks over moves as
no similarity does; a still background does, and whatever else moves before it would bend a homography. As many again
have to agree with a similarity as with a background that stands still."""


@dataclass(frozen=True, eq=False)
class MaskMotion:
    """The last mask carried into the present crop."""

    source: NDArray[np.float32]  # (S, S, 2) float32, where each present pixel was in the last crop, (x, y)
    by_flow: NDArray[np.float32]  # (S, S) float32 in [0, 1], the last mask warped by the flow
    by_similarity: NDArray[np.float32]  # (S, S) float32 in [0, 1], the last mask moved by one similarity
    # (S, S) float32 pixels: how much better a pixel's motion fits the object's affine motion than the
    # background's; 0 if it is unknown
    cue: NDArray[np.float32]
    # (3, 3), the background's homography from present to last pixels, a similarity where that explains as
    # much; None if it is unknown
    background: NDArray[np.float64] | None

    @property
    def moved(self) -> NDArray[np.bool_]:
        """``(S, S)``: the last mask moved along, by flow and similarity together."""
        return self.by_flow + self.by_similarity > 1.0


def follow_mask(
    last: NDArray[np.uint8],
    present: NDArray[np.uint8],
    mask: NDArray[np.float32],
    similarity: bool = True,
    shift: tuple[float, float] = (0.0, 0.0),
    in_frame: NDArray[np.bool_] | None = None,
) -> MaskMotion:
    """Carry a mask into the next crop.

    DIS optical flow (Kroeger et al. 2016) runs both ways; models of motion are RANSAC fits to the flow that
    survives the round trip.

    Args:
        last: ``(S, S)`` the last crop, grey.
        present: ``(S, S)`` the present one.
        mask: ``(S, S)`` in the last crop.
        similarity: Whether the mask is moved by a similarity, too; by the flow alone if not.
        shift: Pixels of the crops from the last crop's place in its frame to the present one's.
        in_frame: ``(S, S)`` what of the present crop lies in its frame; all if None.
    """
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    backward = dis.calc(present, last, None)
    forward = dis.calc(last, present, None)
    rows, columns = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float32)
    target = np.dstack([columns, rows])
    source = target + backward
    returned = backward + cv2.remap(forward, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    reliable = _length(returned) < MAX_ROUND_TRIP
    by_flow = cv2.remap(mask, source, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)

    inside = by_flow > 0.5
    fit = _fit(cv2.estimateAffinePartial2D, source, target, inside & reliable) if similarity else None
    by_similarity = by_flow if fit is None else cv2.warpAffine(mask, fit, mask.shape[::-1])
    beside = reliable & ~inside if in_frame is None else reliable & ~inside & in_frame
    background = _background_motion(target, source, beside, shift)
    object_ = _fit(cv2.estimateAffine2D, target, source, inside & reliable)
    cue = _motion_cue(present, source, target, background, object_, reliable)
    return MaskMotion(source, by_flow, by_similarity, cue, background)


def _motion_cue(
    grey: NDArray[np.uint8],
    source: NDArray[np.float32],
    target: NDArray[np.float32],
    background: NDArray[np.float64] | None,
    object_: NDArray[np.float64] | None,
    reliable: NDArray[np.bool_],
) -> NDArray[np.float32]:
    if background is None or object_ is None:
        return np.zeros(grey.shape, np.float32)
    cue = _residual(background, target, source) - _residual(np.vstack([object_, _LAST_ROW]), target, source)
    gradient = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    texture = 1.0 - np.exp(-cv2.blur(gradient, (9, 9)) / 40.0)  # flow in flat regions is interpolation
    return np.clip(cue, -2.0, 2.0) * texture * reliable


def _background_motion(
    target: NDArray[np.float32],
    source: NDArray[np.float32],
    selected: NDArray[np.bool_],
    shift: tuple[float, float],
) -> NDArray[np.float64] | None:
    """``(3, 3)`` from present to last pixels ``(S, S, 2)``, by those that are selected; None if they are too few."""
    pick = selected[::_STRIDE, ::_STRIDE]
    if np.count_nonzero(pick) < _LEAST:
        return None
    here, there = (points[::_STRIDE, ::_STRIDE][pick] for points in (target, source))
    similarity, agreeing = cv2.estimateAffinePartial2D(
        here, there, method=cv2.RANSAC, ransacReprojThreshold=_AGREEING, maxIters=500
    )
    if similarity is not None:
        ways = here + np.asarray(shift, np.float32), cv2.transform(here[None], similarity)[0]
        still, moving = (np.count_nonzero(np.linalg.norm(way - there, axis=1) < _STILL) for way in ways)
        if _MORE * still >= moving:
            return np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]], _LAST_ROW])
    wanted = 0.0 if similarity is None else _MORE * np.count_nonzero(agreeing)
    if wanted <= len(here):
        homography, agreeing = cv2.findHomography(here, there, cv2.RANSAC, _AGREEING, maxIters=500)
        if homography is not None and np.count_nonzero(agreeing) >= wanted:
            return homography
    return None if similarity is None else np.vstack([similarity, _LAST_ROW])


def _fit(estimate, source, target, selected) -> NDArray[np.float64] | None:  # type: ignore[no-untyped-def]
    pick = selected[::_STRIDE, ::_STRIDE]
    if np.count_nonzero(pick) < _LEAST:
        return None
    matrix, _ = estimate(
        source[::_STRIDE, ::_STRIDE][pick],
        target[::_STRIDE, ::_STRIDE][pick],
        method=cv2.RANSAC,
        ransacReprojThreshold=_AGREEING,
        maxIters=500,
    )
    return matrix


def _residual(
    matrix: NDArray[np.float64], points: NDArray[np.float32], images: NDArray[np.float32]
) -> NDArray[np.float32]:
    return _length(cv2.perspectiveTransform(points, matrix) - images)


def _length(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(H, W)`` of vectors ``(H, W, 2)``: what ``np.linalg.norm`` gives, in a quarter of its time."""
    x, y = vectors[..., 0], vectors[..., 1]
    return np.sqrt(x * x + y * y)
