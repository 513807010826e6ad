"""A confidence that is fitted is calibrated where the model holds, and bears missing and wild evidence."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from tracking3d_bench.evaluation.calibration import area_under_roc, expected_calibration_error
from tracking3d_bench.evaluation.confidence_fit import as_logistic_model, fit_confidence, halves


def made(count, seed=0):
    """Evidence of which two numbers matter, and answers that are right as often as the true model says."""
    rng = np.random.default_rng(seed)
    evidence = {
        "silhouette": rng.uniform(0, 1, count),
        "matching": rng.normal(3, 2, count),
        "noise": rng.normal(size=count),
        "constant": np.full(count, 7.0),
    }
    odds = 1.0 - 4.0 * evidence["silhouette"] + 0.8 * evidence["matching"]
    return evidence, rng.random(count) < expit(odds)


def test_the_model_is_found_and_calibrated_on_frames_it_has_not_seen():
    fit = fit_confidence(*made(20_000))
    terms = {one.name: one for one in fit.terms}
    assert terms["silhouette"].weight == pytest.approx(-4.0, rel=0.1)
    assert terms["matching"].weight == pytest.approx(0.8, rel=0.1)
    assert terms["noise"].weight == pytest.approx(0, abs=0.1) and terms["constant"].weight == 0
    evidence, right = made(20_000, seed=1)
    said = fit(evidence)
    assert expected_calibration_error(said, right) < 0.015
    assert said[right].mean() > said[~right].mean() + 0.2


def test_the_unit_of_the_evidence_changes_nothing():
    evidence, right = made(500)
    scaled = {name: 1000 * value - 3 for name, value in evidence.items()}
    assert fit_confidence(scaled, right)(scaled) == pytest.approx(
        fit_confidence(evidence, right)(evidence), abs=1e-3
    )


def test_what_is_missing_may_say_something_of_its_own():
    rng = np.random.default_rng(0)
    right = rng.random(4000) < 0.5
    # Known only where matching worked; its value says something too.
    matching = np.where(rng.random(4000) < np.where(right, 0.9, 0.2), rng.normal(9 + right), np.nan)
    fit = fit_confidence({"matching": matching}, right)
    said = fit({"matching": matching})
    assert said[np.isfinite(matching)].mean() == pytest.approx(right[np.isfinite(matching)].mean(), abs=0.02)
    assert said[np.isnan(matching)].mean() == pytest.approx(right[np.isnan(matching)].mean(), abs=0.02)


def test_evidence_that_is_never_known_changes_nothing():
    evidence, right = made(500)
    without = fit_confidence(evidence, right)(evidence)
    evidence["other"] = np.full(500, np.nan)
    assert fit_confidence(evidence, right)(evidence) == pytest.approx(without, abs=0.01)


def test_evidence_beyond_what_was_seen_counts_no_further():
    evidence, right = made(2000)
    fit = fit_confidence(evidence, right)
    far = {name: np.array([value.max(), 1e9]) for name, value in evidence.items()}
    assert fit(far)[0] == fit(far)[1] and np.isfinite(fit(far)).all()


def test_a_sign_keeps_evidence_from_speaking_the_other_way():
    evidence, right = made(5000)
    fit = fit_confidence(evidence, right, {"silhouette": 1, "matching": 1, "noise": -1})
    weights = {one.name: one.weight for one in fit.terms}
    assert weights["silhouette"] == 0 and weights["matching"] > 0.5 and weights["noise"] <= 0


def test_a_larger_penalty_gives_smaller_coefficients():
    weights = [abs(fit_confidence(*made(200), penalty=p).terms[0].weight) for p in (0.1, 10, 1000)]
    assert weights[0] > weights[1] > weights[2]


def test_the_table_as_a_file_says_the_same():
    evidence, right = made(200)
    fit = fit_confidence(evidence, right)
    model = as_logistic_model(fit, "made", "none")
    said = [model.probability({name: values[n] for name, values in evidence.items()}) for n in range(200)]
    assert said == pytest.approx(fit(evidence), abs=1e-12)
    assert (model.data, model.error) == ("made", "none")


@pytest.mark.parametrize("right", [np.ones(5, bool), np.zeros(5, bool)])
def test_nothing_is_learnt_where_all_are_right_or_all_wrong(right):
    with pytest.raises(ValueError, match="right and wrong ones"):
        fit_confidence({"a": np.arange(5.0)}, right)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="matching needs shape"):
        fit_confidence({"matching": np.zeros(4)}, np.array([True, False, True]))
    with pytest.raises(KeyError, match="a"):
        fit_confidence({"a": np.arange(4.0)}, np.array([True, False, True, False]))({"b": np.zeros(1)})


def test_the_halves_share_no_sequence_and_do_not_depend_on_order():
    first, second = halves(["c", "a", "b", "a", "d"])
    assert (first, second) == (["a", "c"], ["b", "d"]) == halves(["d", "b", "c", "a"])


def test_the_area_under_the_curve_of_ranks():
    right = np.array([True, True, False, False])
    assert area_under_roc([0.9, 0.3, 0.3, 0.1], right) == pytest.approx(3.5 / 4)


def test_an_estimate_with_twice_the_weight_counts_as_two():
    silhouette = np.array([0.0] * 6 + [1.0] * 6)
    right = np.array([True] * 4 + [False] * 2 + [True, False, False, False, False, False])
    weights = np.where(right, 2.0, 1.0)
    twice = np.repeat(np.arange(12), weights.astype(int))
    weighed = fit_confidence({"silhouette": silhouette}, right, penalty=1e-9, weights=weights)
    repeated = fit_confidence({"silhouette": silhouette[twice]}, right[twice], penalty=1e-9)
    ends = {"silhouette": np.array([0.0, 1.0])}
    assert weighed(ends) == pytest.approx([8 / 10, 2 / 7], abs=1e-3)
    assert weighed(ends) == pytest.approx(repeated(ends), abs=1e-3)
