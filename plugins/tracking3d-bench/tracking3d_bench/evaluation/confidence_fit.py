"""Fit of the confidence: logistic regression of correctness on a few features known without ground truth.

Cox, "The regression analysis of binary sequences", 1958. A number counts between the bounds that it was seen within,
so that no outlier decides, and if it is missing, a constant stands for it. The result is a small table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import expit

from tracking3d.runtime.logistic_model import LogisticModel
from tracking3d.runtime.logistic_model import Term as LogisticTerm
from tracking3d_bench.evaluation.arrays import booleans, floats

BOUNDS = 2.0, 98.0
"""Percentiles of the evidence beyond which it counts no further."""

PENALTY = 1.0
"""Weight of half the squared coefficients, of evidence of unit variance, next to the sum of the log losses."""

_BOUNDS_OF_SIGN: dict[int, tuple[float | None, float | None]] = {1: (0.0, None), -1: (None, 0.0)}


@dataclass(frozen=True)
class Term:
    """What one number adds to the log odds.

    Attributes:
        name: Name of the evidence.
        weight: Its coefficient.
        low, high: It is clipped to them.
        missing: What is added if unknown.
    """

    name: str
    weight: float
    low: float
    high: float
    missing: float


@dataclass(frozen=True)
class LogisticConfidence:
    """The log odds of being right are ``intercept`` and the sum of the terms.

    Attributes:
        intercept: Added always.
        terms: One for each number.
    """

    intercept: float
    terms: tuple[Term, ...]

    def __call__(self, evidence: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """Confidences ``(N,)`` in [0, 1] of N estimates, from their evidence ``(N,)`` by name; NaN is not known.

        Raises:
            KeyError: If evidence that the fit used is not there.
        """
        odds = self.intercept + sum(
            (_contribution(term, np.asarray(evidence[term.name], float)) for term in self.terms), np.zeros(1)
        )
        return np.asarray(expit(odds), dtype=np.float64)


def fit_confidence(
    evidence: Mapping[str, ArrayLike],
    right: ArrayLike,
    signs: Mapping[str, int] | None = None,
    penalty: float = PENALTY,
    weights: ArrayLike | None = None,
) -> LogisticConfidence:
    """Fit the confidence that makes what was seen the likeliest, with small coefficients.

    Args:
        evidence: ``(N,)`` by name; NaN if unknown. What never differs gets the weight 0.
        right: ``(N,)`` bool, whether the estimates were right.
        signs: 1 for evidence that can only speak for an estimate, -1 for what can only speak against it, as a loss
            does;
            what is not named may do either.
        penalty: See `PENALTY`.
        weights: ``(N,)``, how much each estimate counts; their mean is made 1. None: all the same.

    Raises:
        ValueError: If a shape does not fit, or all estimates are right or all wrong: then nothing can be learnt.
    """
    was_right = booleans("right", right, None)
    if was_right.all() or not was_right.any():
        raise ValueError(
            f"of {len(was_right)} estimates {was_right.sum()} are right; right and wrong ones are needed"
        )
    names = list(evidence)
    values = [floats(name, evidence[name], len(was_right)) for name in names]
    columns, scales = zip(*(_standardize(value) for value in values), strict=True) if names else ((), ())
    known = [np.isfinite(value) for value in values]
    # What is missing is its mean, and an indicator says that it is.
    design = np.column_stack([np.ones(len(was_right)), *columns, *(~one for one in known)]).astype(float)
    free = (None, None)
    bounds = [_BOUNDS_OF_SIGN.get((signs or {}).get(name, 0), free) for name in names]
    counts = np.ones(len(was_right)) if weights is None else floats("weights", weights, len(was_right))
    found = _fit(design, was_right, counts / counts.mean(), penalty, [free, *bounds, *(free for _ in names)])
    intercept, slopes, absent = found[0], found[1 : len(names) + 1], found[len(names) + 1 :]
    terms = []
    for name, (mean, spread, low, high), slope, gap in zip(names, scales, slopes, absent, strict=True):
        weight = slope / spread
        intercept -= weight * mean
        terms.append(Term(name, float(weight), low, high, float(gap + weight * mean)))
    return LogisticConfidence(float(intercept), tuple(terms))


def as_logistic_model(confidence: LogisticConfidence, data: str, error: str) -> LogisticModel:
    """The table as the package keeps it, of today's date, see `LogisticModel`; it has no numbers that are missing."""
    terms = {one.name: LogisticTerm(one.weight, one.low, one.high) for one in confidence.terms}
    right = "an estimate is right: within 10 degrees and above an IoU of 0.7"
    return LogisticModel(right, data, date.today().isoformat(), error, confidence.intercept, terms)


def halves(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Distinct names in alphabetical order, every other one in the same half."""
    distinct = sorted(set(names))
    return distinct[::2], distinct[1::2]


def _contribution(term: Term, values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), term.weight * np.clip(values, term.low, term.high), term.missing)


def _standardize(
    values: NDArray[np.float64],
) -> tuple[NDArray[np.float64], tuple[float, float, float, float]]:
    """Values ``(N,)`` of mean 0 and variance 1 within their bounds, 0 where missing; mean, spread and bounds."""
    known = values[np.isfinite(values)]
    if not len(known):
        return np.zeros(len(values)), (0.0, 1.0, 0.0, 0.0)
    low, high = (float(bound) for bound in np.percentile(known, BOUNDS))
    clipped = np.clip(known, low, high)
    mean, spread = float(clipped.mean()), float(clipped.std())
    if spread < 1e-9 * max(abs(low), abs(high), 1e-9):  # it never differs but by rounding
        return np.zeros(len(values)), (mean, 1.0, low, high)
    scaled = (np.clip(values, low, high) - mean) / spread
    return np.where(np.isfinite(values), scaled, 0.0), (mean, spread, low, high)


def _fit(
    design: NDArray[np.float64],
    right: NDArray[np.bool_],
    counts: NDArray[np.float64],
    penalty: float,
    bounds: Sequence[tuple[float | None, float | None]],
) -> NDArray[np.float64]:
    """Coefficients ``(K,)`` of the columns of a design ``(N, K)`` within bounds; the first one is not held small."""
    held = np.full(design.shape[1], penalty)
    held[0] = 0.0

    def loss(weights: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        odds = design @ weights
        value = counts @ (np.logaddexp(0, odds) - odds * right) + 0.5 * held @ weights**2
        return float(value), design.T @ (counts * (expit(odds) - right)) + held * weights

    found = minimize(loss, np.zeros(design.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds)
    return np.asarray(found.x, dtype=np.float64)
