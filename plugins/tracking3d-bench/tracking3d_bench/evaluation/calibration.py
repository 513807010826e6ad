"""Calibration of confidence, and precision and recall of the status lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.evaluation.arrays import booleans, check_shape, finite

BINS = 10
"""Bins of equal width between 0 and 1."""


@dataclass(frozen=True, eq=False)
class Reliability:
    """Estimates sorted into bins by confidence, the data of a reliability diagram.

    Bin ``m`` holds confidences above its lower edge up to its upper edge; the first holds 0 too.

    Attributes:
        edges: ``(M + 1,)``.
        count: ``(M,)`` estimates in each bin.
        confidence: ``(M,)`` their mean confidence; NaN in an empty bin.
        accuracy: ``(M,)`` the share of them that is right; NaN in an empty bin.
    """

    edges: NDArray[np.float64]
    count: NDArray[np.int64]
    confidence: NDArray[np.float64]
    accuracy: NDArray[np.float64]


@dataclass(frozen=True)
class Detection:
    """How well something is detected.

    Attributes:
        precision: Share of what was called that is; None if nothing was called.
        recall: Share of what is that was called; None if nothing is.
        f1: Their harmonic mean, ``2 TP / (2 TP + FP + FN)``; None if nothing is and nothing was called.
    """

    precision: float | None
    recall: float | None
    f1: float | None


def reliability(confidence: ArrayLike, right: ArrayLike, bins: int = BINS) -> Reliability:
    """Sort N estimates into ``bins`` bins of equal width.

    Args:
        confidence: ``(N,)`` in [0, 1].
        right: ``(N,)`` bool.
        bins: Number of bins M.

    Raises:
        ValueError: If the shapes differ or a confidence is not in [0, 1].
    """
    said = finite("confidence", confidence, None)
    was_right = booleans("right", right, len(said))
    if ((said < 0) | (said > 1)).any():
        raise ValueError(f"confidence needs values in [0, 1], got {said.min()} to {said.max()}")
    edges = np.linspace(0, 1, bins + 1)
    bin_of = np.maximum(np.searchsorted(edges, said, side="left") - 1, 0)
    count = np.bincount(bin_of, minlength=bins)
    share = np.where(count, count, np.nan)
    return Reliability(
        edges=edges,
        count=count,
        confidence=np.bincount(bin_of, said, bins) / share,
        accuracy=np.bincount(bin_of, was_right, bins) / share,
    )


def expected_calibration_error(confidence: ArrayLike, right: ArrayLike, bins: int = BINS) -> float | None:
    """Mean over all estimates of the gap between accuracy and mean confidence of their bin.

    Guo et al., "On calibration of modern neural networks", ICML 2017. None without estimates.

    Args:
        confidence: ``(N,)`` in [0, 1].
        right: ``(N,)`` bool.
        bins: Number of bins.

    Raises:
        ValueError: If the shapes differ or a confidence is not in [0, 1].
    """
    found = reliability(confidence, right, bins)
    if not found.count.any():
        return None
    gaps = np.abs(found.accuracy - found.confidence)
    return float(np.nansum(found.count * gaps) / found.count.sum())


def area_under_roc(score: ArrayLike, right: ArrayLike) -> float | None:
    """Area under the ROC curve: the probability that a right estimate has a higher score than a wrong one.

    By ranks (Mann and Whitney, 1947); ties count for a half. None if all are right or all wrong.

    Args:
        score: ``(N,)``.
        right: ``(N,)`` bool.

    Raises:
        ValueError: If the shapes differ or a score is not finite.
    """
    said = finite("score", score, None)
    was_right = np.asarray(right, bool)
    check_shape("right", was_right.shape, len(said))
    good, bad = np.count_nonzero(was_right), np.count_nonzero(~was_right)
    if not good or not bad:
        return None
    from scipy.stats import rankdata  # slow to import

    return float((rankdata(said)[was_right].sum() - good * (good + 1) / 2) / (good * bad))


def detection_scores(called: ArrayLike, actual: ArrayLike) -> Detection:
    """Precision, recall and F1 of what was called, such as lost frames, against what is.

    Args:
        called: ``(N,)`` bool.
        actual: ``(N,)`` bool.

    Raises:
        ValueError: If the shapes differ or the values are not bool.
    """
    is_so = booleans("actual", actual, None)
    said_so = booleans("called", called, len(is_so))
    both, said, so = (np.count_nonzero(one) for one in (said_so & is_so, said_so, is_so))
    return Detection(
        precision=both / said if said else None,
        recall=both / so if so else None,
        f1=2 * both / (said + so) if said + so else None,
    )
