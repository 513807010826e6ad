"""The uncertainty of a mean over sequences, from the choice of sequences.

The sequences are the sample; the interval is the percentile bootstrap over them (Efron, "Bootstrap methods: another
look at the jackknife", 1979).
"""

from __future__ import annotations

import numpy as np

LEVEL = 0.95
RESAMPLES = 9999


def interval(values: np.ndarray, seed: int = 0) -> tuple[float | None, float | None]:
    """Percentile bootstrap interval of the mean of ``values`` ``(N,)`` at `LEVEL`.

    None for fewer than two values, and if one is not finite.
    """
    if len(values) < 2 or not np.isfinite(values).all():
        return None, None
    if np.ptp(values) == 0:
        return float(values[0]), float(values[0])
    from scipy.stats import bootstrap  # slow to import

    result = bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)
