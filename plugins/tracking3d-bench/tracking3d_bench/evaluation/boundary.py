"""DAVIS: region similarity J, boundary accuracy F and the statistics of a sequence.

As ``davis2017-evaluation`` computes them (Perazzi et al., "A benchmark dataset and evaluation methodology for video
object segmentation", CVPR 2016; Pont-Tuset et al., "The 2017 DAVIS challenge"). Void pixels, if a data set has
them, are taken out of both masks before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.evaluation.arrays import booleans, floats
from tracking3d_bench.evaluation.metrics import mask_iou

TOLERANCE = 0.008
"""How far apart boundaries match, in image diagonals, rounded up to a pixel."""

GOOD = 0.5
"""A frame counts as recalled above this value."""


@dataclass(frozen=True)
class SequenceStatistics:
    """What DAVIS reports of the values of one object in one sequence.

    Attributes:
        mean: Mean of all frames.
        recall: Share of frames above 0.5.
        decay: Mean of the first quarter of the frames minus that of the last.
    """

    mean: float
    recall: float
    decay: float


def davis_jaccard(mask: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    """J: intersection over union of two ``(H, W)`` masks; 1 if both are empty.

    Raises:
        ValueError: If the shapes differ or the masks are not bool.
    """
    return mask_iou(*_pair(mask, true))


def boundary_f(mask: NDArray[np.bool_], true: NDArray[np.bool_]) -> float:
    """F: harmonic mean of the precision and recall of the boundary pixels of ``mask``, ``(H, W)``.

    A boundary pixel is right if it is within `TOLERANCE` of the other boundary. Two masks without a boundary agree
    fully; if only one has none, F is 0. A mask that fills the frame has no boundary either.

    Raises:
        ValueError: If the shapes differ or the masks are not bool.
    """
    estimated, reference = (boundary_map(one) for one in _pair(mask, true))
    if not estimated.any() or not reference.any():
        return float(estimated.any() == reference.any())
    disk = _disk(math.ceil(TOLERANCE * math.hypot(*true.shape)))
    precision, recall = (
        np.count_nonzero(a & (cv2.dilate(b.astype(np.uint8), disk) > 0)) / np.count_nonzero(a)
        for a, b in ((estimated, reference), (reference, estimated))
    )
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def boundary_map(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels ``(H, W)`` that differ from their neighbour to the east, the south or the south-east.

    The last row looks east only and the last column south only; the last pixel is never one. The edge of the frame
    is no boundary. It lies half a pixel towards the origin of the true boundary (``seg2bmap`` of the Berkeley
    segmentation benchmark, Martin et al. 2003).
    """
    boundary = np.zeros_like(mask)
    boundary[:, :-1] |= mask[:, :-1] != mask[:, 1:]
    boundary[:-1] |= mask[:-1] != mask[1:]
    boundary[:-1, :-1] |= mask[:-1, :-1] != mask[1:, 1:]
    return boundary


def davis_statistics(values: ArrayLike, semi_supervised: bool = True) -> SequenceStatistics | None:
    """Mean, recall and decay of the values ``(T,)`` of all frames of a sequence.

    Args:
        values: J or F by frame. NaN is left out of the means and not recalled.
        semi_supervised: Leave out the first frame, whose mask was given, and the last, as DAVIS does.

    Returns:
        None if no frame is left.

    Raises:
        ValueError: If the shape is another.
    """
    scored = floats("values", values, None)
    scored = scored[1:-1] if semi_supervised else scored
    known = ~np.isnan(scored)
    if not known.any():
        return None
    # Four parts that share their end frames; the constant rounds halves up.
    ends = (np.round(np.linspace(1, len(scored), 5) + 1e-10) - 1).astype(int)
    first, last = (scored[ends[i] : ends[i + 1] + 1] for i in (0, 3))
    return SequenceStatistics(
        mean=float(scored[known].mean()),
        recall=float(np.mean(scored > GOOD)),
        decay=float(_mean(first) - _mean(last)),
    )


def _mean(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else math.nan


def _pair(mask: NDArray[np.bool_], true: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    true = booleans("true", true, None, None)
    return booleans("mask", mask, *true.shape), true


def _disk(radius: int) -> NDArray[np.uint8]:
    """Pixels within ``radius`` of the centre, the footprint ``disk`` of scikit-image."""
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    return (x**2 + y**2 <= radius**2).astype(np.uint8)
