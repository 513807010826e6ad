"""Fit how far followed points are off, and test it on sequences of another seed.

::

    tracking3d evaluate suite fresh --seed 9200 --masks truth --out OUT      # to fit
    tracking3d evaluate suite fresh --seed 401 --masks truth --out OTHER     # to test
    python training/point_uncertainty.py OUT OTHER

The weights that it prints belong into ``tracking3d/points/follow.py``. Quantile regression (Koenker and Bassett,
"Regression quantiles", 1978) of the logarithm of the error, in pixels of the frame: what is fitted is the quantile of
0.95, half of which is the uncertainty.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import torch

from tracking3d_bench.benchmark.point_runs import PointErrors, finished_jobs, measure_run

QUANTILE = 0.95


def fit(known: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Weights ``(F,)`` of features ``(N, F)`` whose sum is the logarithm of half the quantile of ``error`` ``(N,)``."""
    x, y = torch.tensor(known), torch.tensor(np.log(np.maximum(error, 1e-3) / 2))
    centre, spread = x[:, 1:].mean(0), x[:, 1:].std(0) + 1e-9
    scaled = torch.cat([x[:, :1], (x[:, 1:] - centre) / spread], 1)
    weights = torch.zeros(x.shape[1], dtype=x.dtype, requires_grad=True)
    optimizer = torch.optim.Adam([weights], lr=0.05)
    for step in range(1500):
        optimizer.param_groups[0]["lr"] = 0.05 * 0.5 ** (step / 300)
        left = y - scaled @ weights
        loss = (
            torch.maximum(QUANTILE * left, (QUANTILE - 1) * left).mean() + 1e-4 * weights[1:].square().sum()
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    found = weights.detach()
    slopes = found[1:] / spread
    return torch.cat([found[:1] - (slopes * centre).sum(), slopes]).numpy()


def collect(folder: Path) -> list[PointErrors]:
    """What is known of all points of all finished runs of an evaluation."""
    return [
        measure_run(job, run, refined).errors
        for job, run in finished_jobs(folder)
        for refined in (True, False)
    ]


if __name__ == "__main__":
    known, error, measured = (
        np.concatenate(part)
        for part in zip(*((e.features, e.error, e.measured) for e in collect(Path(sys.argv[1]))), strict=True)
    )
    for name, chosen in (("MEASURED", measured), ("PREDICTED", ~measured)):
        print(name, "=", tuple(round(float(one), 3) for one in fit(known[chosen], error[chosen])))
    if len(sys.argv) > 2:
        tested = collect(Path(sys.argv[2]))
        shares = [float(np.mean(e.error <= 2 * e.uncertainty)) for e in tested if len(e.error)]
        print("inside two sigma, mean of sequences:", round(math.fsum(shares) / len(shares), 3))
