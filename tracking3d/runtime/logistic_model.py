"""Logistic regressions from files: how likely something is by a few features that are known without ground truth."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

_WEIGHTS = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Term:
    """What a feature adds to the log-odds."""

    weight: float
    low: float  # a feature counts no further than the range that was seen in the fit
    high: float


@dataclass(frozen=True)
class LogisticModel:
    """Log-odds that are linear in clipped features; ``training/confidence.py`` writes the table."""

    predicts: str  # what it is the probability of
    data: str  # what it was fitted to
    date: str  # of the fit
    error: str  # what it is worth, where possible on other data
    intercept: float
    terms: Mapping[str, Term]  # by the name of the feature

    @staticmethod
    def load(name: str) -> LogisticModel:
        """One of the tables in ``runtime/weights``."""
        table = json.loads((_WEIGHTS / f"{name}.json").read_text(encoding="utf-8"))
        return LogisticModel(
            **{**table, "terms": {key: Term(**term) for key, term in table["terms"].items()}}
        )

    def log_odds(self, features: Mapping[str, float]) -> dict[str, float]:
        """What each feature adds, by name; features without a term add nothing."""
        return {
            name: term.weight * min(max(features[name], term.low), term.high)
            for name, term in self.terms.items()
        }

    def probability(self, features: Mapping[str, float]) -> float:
        """How likely what it predicts is."""
        return 1 / (1 + math.exp(-(self.intercept + sum(self.log_odds(features).values()))))
