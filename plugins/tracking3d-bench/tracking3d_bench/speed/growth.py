"""How the time of one iteration grows with the problem: pixels, faces, frames and channels, one after the other."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import torch

from tracking3d_bench.speed.scene import RenderWorkload
from tracking3d_bench.speed.timing import Duration, median, time_backends

RANGES: dict[str, list[dict[str, int]]] = {
    "pixels": [{"size": side} for side in (64, 96, 128, 192, 256, 384)],
    "faces": [{"frequency": frequency} for frequency in (4, 6, 8, 11, 16, 22)],
    "frames": [{"frames": frames} for frames in (1, 2, 4, 7, 12, 16)],
    "channels": [{"channels": channels, "texture": 150} for channels in (1, 3, 8, 16, 32, 64, 128)],
}
"""What grows, a property of `RenderWorkload`, and the settings that make it grow."""

LINEAR = 1.05
"""Exponents up to this are linear or better: measurements are noisy."""
_PASSES = 3


def measure_growth(
    problem: RenderWorkload, device: torch.device, repeats: int, threads: int
) -> dict[str, dict[str, Any]]:
    """Time every backend while one property of the problem grows.

    Args:
        problem: What does not grow.
        device: See `time_backends`, also for the others.
        repeats: Measurements of each backend at each point, made in up to three passes over all points.
        threads: CPU threads.

    Returns:
        For each of `RANGES` the ``values``, and by backend the medians ``total_ms`` at these, their ``exponent`` and
        whether that is ``linear_or_better``.
    """
    problems = {name: [replace(problem, **change) for change in changes] for name, changes in RANGES.items()}
    # Another program that keeps the machine busy for a while spoils one pass of a few points, not all of one point.
    passes = min(_PASSES, repeats)
    times: dict[RenderWorkload, dict[str, list[Duration]]] = defaultdict(lambda: defaultdict(list))
    for _ in range(passes):
        for one in chain.from_iterable(problems.values()):
            for backend, measured in time_backends(one, device, -(-repeats // passes), threads).items():
                times[one][backend] += measured
    return {
        name: _grown([getattr(one, name) for one in several], [times[one] for one in several])
        for name, several in problems.items()
    }


def exponent(values: Sequence[float], times: Sequence[float]) -> float:
    """The power of ``values`` that ``times`` grow with over the upper half of the range.

    It is the slope of the least-squares line of their logarithms, over the larger half of the values; with an odd
    number of them the middle one is among them. What does not grow makes up most of the times before.

    Args:
        values: At least three, rising.
        times: As many.
    """
    upper = len(values) // 2
    logarithms = ([math.log(number) for number in numbers[upper:]] for numbers in (values, times))
    return statistics.linear_regression(*logarithms).slope


def _grown(values: list[int], times: list[dict[str, list[Duration]]]) -> dict[str, Any]:
    """What `measure_growth` says of one property, from its values and the measurements there."""
    total = {backend: [round(median(point[backend]).total, 3) for point in times] for backend in times[0]}
    exponents = {backend: round(exponent(values, medians), 3) for backend, medians in total.items()}
    return {
        "values": values,
        "total_ms": total,
        "exponent": exponents,
        "linear_or_better": {backend: power <= LINEAR for backend, power in exponents.items()},
    }
