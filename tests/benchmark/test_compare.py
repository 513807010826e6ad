"""A comparison finds a difference that is there, and does not find one that is not."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.errors import InputError
from tracking3d_bench.benchmark.compare import compare, interval
from tracking3d_bench.benchmark.results import ResultSet


def results(label, values, measure="iou_mean", dataset="standard", **about):
    scores = {f"s{n}": {measure: value} for n, value in enumerate(values)}
    return ResultSet(label, dataset, scores, {}, about)


def test_a_constant_gain_has_a_point_as_its_interval():
    [found] = compare(results("A", [0.5, 0.6, 0.7]), results("B", [0.6, 0.7, 0.8]))
    assert (found.a, found.b) == pytest.approx((0.6, 0.7))
    assert (found.low, found.high) == pytest.approx((0.1, 0.1))
    assert found.verdict == "B is better"


def test_more_is_worse_where_the_measure_is_an_error():
    measure = "rotation_error_mean_deg"
    [found] = compare(results("A", [5, 6, 7], measure), results("B", [9, 9, 9], measure))
    assert found.verdict == "B is worse"


def test_noise_is_no_difference():
    random = np.random.default_rng(0)
    a = random.uniform(0.5, 0.9, 12)
    [found] = compare(results("A", a), results("B", a + random.normal(0, 0.1, 12)))
    assert found.low < 0 < found.high
    assert found.verdict == "no difference shown"


def test_the_interval_covers_the_true_mean_about_as_often_as_it_says():
    random = np.random.default_rng(1)
    covered = []
    for seed in range(60):
        low, high = interval(random.normal(0.3, 1, 20), seed)
        covered.append(low < 0.3 < high)
    assert 0.8 < np.mean(covered) <= 1


def test_the_same_seed_gives_the_same_interval():
    differences = np.random.default_rng(2).normal(size=9)
    assert interval(differences, 3) == interval(differences, 3)


def test_one_sequence_is_too_few():
    [found] = compare(results("A", [0.5]), results("B", [0.9]))
    assert (found.low, found.verdict) == (None, "too few sequences")


def test_only_common_sequences_are_paired():
    a, b = results("A", [0.5, 0.6]), results("B", [0.6, 0.7, 0.1])
    b.scores["s0"] = None  # failed
    [found] = compare(a, b)
    assert found.differences == pytest.approx({"s1": 0.1})
    assert (found.a, found.b) == pytest.approx((0.6, 0.7))


def test_results_of_different_data_are_refused():
    with pytest.raises(InputError, match="different data"):
        compare(results("A", [1.0]), results("B", [1.0], dataset="full"))
    with pytest.raises(InputError, match="standard version 1 and standard version 2"):
        compare(results("A", [1.0], suite_version=1), results("B", [1.0], suite_version=2))
    with pytest.raises(InputError, match="no scored sequence in common"):
        compare(results("A", [None]), results("B", [1.0]))
