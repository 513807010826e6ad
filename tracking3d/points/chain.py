"""Points followed from one view through all others, forwards and backwards in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tracking3d.points.carrying import Warps
from tracking3d.points.view import Array

STEPS = (1, 3, 7)
"""How many views back the templates are taken from; the mean of what they say, by their variances, counts."""


@dataclass(frozen=True, eq=False)
class Chain:
    """What the images say about N points in T views, in pixels of each view.

    Attributes:
        measured: ``(T, N, 2)``; NaN where the image says nothing.
        variance: ``(T, N)`` squared pixels, that of the steps before included; infinite there, 0 at the start.
        likeness: ``(T, N)`` best likeness to a template, see `Carried`; -1 where there was none.
    """

    measured: Array
    variance: Array
    likeness: Array


def follow_chain(warps: Warps, start: int, xy: Array, steps: Sequence[int] = STEPS) -> Chain:
    """Follow pixels ``xy`` ``(N, 2)`` of view ``start`` from view to view.

    A point that the views just before do not hold, since it was hidden there, is looked for again with the template of
    its first view.
    """
    views, count = len(warps.views), len(xy)
    chain = Chain(
        np.full((views, count, 2), np.nan), np.full((views, count), np.inf), np.full((views, count), -1.0)
    )
    chain.measured[start], chain.variance[start], chain.likeness[start] = xy, 0.0, 1.0
    for direction, path in ((1, range(start + 1, views)), (-1, range(start - 1, -1, -1))):
        for target in path:
            if warps.views[target] is None:
                continue
            before = [target - direction * step for step in steps]
            extend(chain, warps, target, [one for one in before if (one - start) * direction >= 0])
            missing = ~np.isfinite(chain.variance[target])
            if missing.any() and start not in before:
                extend(chain, warps, target, [start], missing)
    return chain


def extend(chain: Chain, warps: Warps, target: int, sources: list[int], of: np.ndarray | None = None) -> None:
    """Write what the templates of some views say about one more view.

    Args:
        chain: Is written to.
        warps: The views.
        target: Index of the view.
        sources: Those of the templates; points that they do not hold are left as they are.
        of: ``(N,)`` which points; None for all.
    """
    count = chain.variance.shape[1]
    total, weights = np.zeros((count, 2)), np.zeros(count)
    for source in sources:
        known = np.isfinite(chain.variance[source])
        chosen = np.flatnonzero(known if of is None else known & of)
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
