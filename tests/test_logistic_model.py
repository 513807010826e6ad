"""Tables of logistic regressions are files that say where they come from."""

from __future__ import annotations

import math
from dataclasses import astuple
from datetime import date
from pathlib import Path

import pytest

import tracking3d.runtime.logistic_model as module
from tracking3d.runtime.logistic_model import LogisticModel, Term

TABLES = sorted(path.stem for path in (Path(module.__file__).parent / "weights").glob("*.json"))


@pytest.mark.parametrize("name", TABLES)
def test_every_table_says_what_it_was_fitted_to_when_and_what_it_is_worth(name):
    model = LogisticModel.load(name)
    assert model.predicts and model.data and model.error and date.fromisoformat(model.date)
    assert model.terms and all(term.low < term.high for term in model.terms.values())


def test_features_count_within_the_range_that_was_seen():
    model = LogisticModel("", "", "", "", 1.0, {"a": Term(-2.0, 0.0, 1.0), "b": Term(3.0, -1.0, 2.0)})
    assert model.log_odds({"a": 5.0, "b": -0.5, "c": 9.0}) == {"a": -2.0, "b": -1.5}
    assert model.probability({"a": 5.0, "b": -0.5}) == pytest.approx(1 / (1 + math.exp(2.5)))


def test_the_score_of_a_mask_is_what_was_fitted():
    terms = LogisticModel.load("mask_score").terms
    assert {name: astuple(term)[0] for name, term in terms.items()} == {
        "agreement": 6.1, "margin": 1.2, "separation": 11.6
    }  # fmt: skip
