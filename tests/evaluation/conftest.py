"""Scores of whole runs: that each is the right one shows without its third digit."""

from __future__ import annotations

import pytest

from tracking3d_bench.evaluation import model_scores


@pytest.fixture(autouse=True)
def surfaces_are_sampled_sparsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scores of the shape alone are tested with as many points as they are computed from."""
    monkeypatch.setattr(model_scores, "SAMPLES", 10_000)
