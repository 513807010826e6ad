"""VOT: overlap of regions, and precision, recall and F of long-term tracking with confidence.

As the ``vot-toolkit`` computes ``average_tpr`` for VOT-RGBD 2019, whose data are CDTB (Lukezic et al., "Now you see me:
evaluating performance in long-term visual tracking", 2018; Kristan et al., "The seventh visual object tracking VOT2019
challenge results", ICCVW 2019).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.evaluation.arrays import booleans, finite, floats
from tracking3d_bench.evaluation.metrics import mask_iou

RESOLUTION = 100
"""Number of confidence thresholds that are tried at most."""


@dataclass(frozen=True, eq=False)
class LongTermSequence:
    """One tracker's result in one sequence of T frames.

    Attributes:
        overlaps: ``(T,)`` of `mask_overlap` or `rectangle_overlap` with the truth, in [0, 1].
        confidence: ``(T,)``; the toolkit takes 0 if the tracker gave none.
        visible: ``(T,)`` bool, whether the truth has a region.
    """

    overlaps: ArrayLike
    confidence: ArrayLike
    visible: ArrayLike


@dataclass(frozen=True)
class LongTermScores:
    """Precision and recall at the confidence threshold with the largest F.

    Attributes:
        precision: Mean overlap where the tracker is confident.
        recall: Sum of these overlaps over the number of frames that show the object.
        f_score: Their harmonic mean.
        threshold: The confidence.
    """

    precision: float
    recall: float
    f_score: float
    threshold: float


def mask_overlap(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two masks ``(H, W)`` of the frame; 1 if both are empty.

    Raises:
        ValueError: If the shapes differ or the masks are not bool.
    """
    first = booleans("a", a, None, None)
    return mask_iou(first, booleans("b", b, *first.shape))


def rectangle_overlap(a: ArrayLike, b: ArrayLike, size: tuple[int, int] | None = None) -> float:
    """Intersection over union of two rectangles in whole pixels; 1 if both are empty.

    Args:
        a, b: ``(4,)`` x, y, width and height. Each is rounded, halves to the even number. One with a NaN, or
            without width or height, is empty.
        size: Width and height of the frame; what lies outside does not count. None counts all.

    Raises:
        ValueError: If a shape does not fit.
    """
    first, second = _corners("a", a), _corners("b", b)
    if first is None or second is None:
        return float(first is second)
    if size is not None:
        first, second = (np.clip(corners, 0, size) for corners in (first, second))
    common = _area(np.maximum(first[0], second[0]), np.minimum(first[1], second[1]))
    union = _area(*first) + _area(*second) - common
    return common / union if union else 0.0


def confidence_thresholds(confidence: ArrayLike, resolution: int = RESOLUTION) -> NDArray[np.float64]:
    """Thresholds from all confidences ``(N,)`` of a tracker, falling, between infinity and minus infinity.

    Up to ``resolution - 2`` confidences are all thresholds. If there are more, as many are taken at even ranks.

    Raises:
        ValueError: If the shape is another or a value is not finite.
    """
    ranked = np.sort(finite("confidence", confidence, None))[::-1]
    wanted = resolution - 2
    if len(ranked) > wanted:
        step = len(ranked) // wanted
        ranked = ranked[np.round(np.linspace(step, len(ranked) - step, wanted)).astype(int)]
    return np.concatenate([[math.inf], ranked, [-math.inf]])


def long_term_curves(
    overlaps: ArrayLike, confidence: ArrayLike, visible: ArrayLike, thresholds: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Precision ``(M,)`` and recall ``(M,)`` of one sequence at each threshold.

    If the tracker is nowhere confident, precision is 1 and recall 0.

    Args:
        overlaps, confidence, visible: ``(T,)``, see `LongTermSequence`.
        thresholds: ``(M,)``; a frame counts from its confidence on.

    Raises:
        ValueError: If the shapes differ, a value is not finite, or no frame shows the object.
    """
    found = finite("overlaps", overlaps, None)
    said = finite("confidence", confidence, len(found))
    seen = np.count_nonzero(booleans("visible", visible, len(found)))
    if not seen:
        raise ValueError(f"no frame of {len(found)} shows the object, so there is no recall")
    confident = said >= floats("thresholds", thresholds, None)[:, None]
    count, total = np.count_nonzero(confident, axis=1), confident @ found
    return np.where(count, total / np.maximum(count, 1), 1.0), total / seen


def long_term_scores(
    sequences: Sequence[LongTermSequence], resolution: int = RESOLUTION
) -> LongTermScores | None:
    """Scores of a tracker: curves over common thresholds, averaged over the sequences, at the largest F.

    None without sequences.

    Raises:
        ValueError: As `long_term_curves`.
    """
    if not sequences:
        return None
    said = [finite("confidence", sequence.confidence, None) for sequence in sequences]
    thresholds = confidence_thresholds(np.concatenate(said), resolution)
    curves = [long_term_curves(one.overlaps, one.confidence, one.visible, thresholds) for one in sequences]
    precision, recall = np.mean(curves, axis=0)
    both = precision + recall
    f_score = np.where(both > 0, 2 * precision * recall / np.where(both > 0, both, 1), 0.0)
    best = int(f_score.argmax())
    return LongTermScores(
        float(precision[best]), float(recall[best]), float(f_score[best]), float(thresholds[best])
    )


def _corners(name: str, rectangle: ArrayLike) -> NDArray[np.float64] | None:
    """``(2, 2)`` first and one past the last pixel; None if empty."""
    x, y, width, height = np.round(floats(name, rectangle, 4))
    return (
        np.array([[x, y], [x + width, y + height]]) if width > 0 and height > 0 and x + y == x + y else None
    )


def _area(first: NDArray[np.float64], end: NDArray[np.float64]) -> float:
    return float(np.prod(np.maximum(end - first, 0)))
