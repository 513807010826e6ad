"""Tracks points from the views that they begin in through all others, forwards and backwards in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.points.warping import Warps
from tracking3d.scene.view import Array

STEPS = (1, 3, 7)
"""How many views back the templates are taken from; the mean of what they say, by their variances, counts."""


@dataclass(frozen=True, eq=False)
class Chain:
    """What the images say about N points in T views, in pixels of each view."""

    measured: Array  # (T, N, 2); NaN if the image says nothing
    # (T, N) squared pixels, that of the steps before included; infinite there, 0 at the start
    variance: Array
    likeness: Array  # (T, N) best likeness to a template, see `Carried`; -1 where there was none


def follow_chain(warps: Warps, start: NDArray[np.integer], xy: Array, steps: Sequence[int] = STEPS) -> Chain:
    """Follow pixels ``xy`` ``(N, 2)`` of views ``start`` ``(N,)`` from view to view.

    A point that the views just before do not hold, since it was hidden there, is looked for again with the template of
    its first view.
    """
    views, count = len(warps.views), len(xy)
    chain = Chain(
        np.full((views, count, 2), np.nan), np.full((views, count), np.inf), np.full((views, count), -1.0)
    )
    rows = np.arange(count)
    chain.measured[start, rows], chain.variance[start, rows], chain.likeness[start, rows] = xy, 0.0, 1.0
    for direction, path in ((1, range(views)), (-1, range(views - 1, -1, -1))):
        for target in path:
            behind = (target - start) * direction  # how many views ago each point began
            if warps.views[target] is None or not (behind > 0).any():
                continue
            before = [
                (target - direction * step, behind >= step)
                for step in steps
                if 0 <= target - direction * step < views
            ]
            extend(chain, warps, target, before)
            missing = ~np.isfinite(chain.variance[target]) & (behind > 0)
            extend(
                chain,
                warps,
                target,
                [
                    (first, missing & (start == first))
                    for first in np.unique(start[missing]).tolist()
                    if abs(target - first) not in steps
                ],
            )
    return chain


def extend(chain: Chain, warps: Warps, target: int, sources: Sequence[tuple[int, NDArray[np.bool_]]]) -> None:
    """Write what the templates of some views say about one more view.

    Args:
        chain: Is written to.
        warps: The views.
        target: Index of the view.
        sources: Those of the templates, and ``(N,)`` which points each is asked for; points that it does not hold are
            left as they are.
    """
    count = chain.variance.shape[1]
    total, weights = np.zeros((count, 2)), np.zeros(count)
    for source, of in sources:
        chosen = np.flatnonzero(of & np.isfinite(chain.variance[source]))
        if not len(chosen):
            continue
        carried = warps.carry(source, target, chain.measured[source, chosen])
        variance = carried.variance + chain.variance[source, chosen]
        weight = np.where(np.isfinite(variance), 1 / variance, 0)
        total[chosen] += weight[:, None] * np.nan_to_num(carried.measured)
        weights[chosen] += weight
        best = np.maximum(chain.likeness[target, chosen], carried.likeness)
        chain.likeness[target, chosen] = best
    found = weights > 0
    chain.measured[target, found] = total[found] / weights[found, None]
    chain.variance[target, found] = 1 / weights[found]
