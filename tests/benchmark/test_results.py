"""Result sets survive their file, and a failed sequence spoils no mean."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d_bench.benchmark.pool import JobOutcome
from tracking3d_bench.benchmark.results import (
    ResultSet,
    collect,
    figure,
    format_results,
    read_results,
    write_results,
)
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.variant import Variant

SCORES = {"a": {"iou_mean": 0.5, "frames_lost": 2}, "b": {"iou_mean": 0.7, "frames_lost": None}, "c": None}
RESULTS = ResultSet("mine", "standard", SCORES, {"c": "it crashed"}, {"suite_version": 1, "masks": "truth"})


def test_a_mean_counts_each_sequence_once_where_it_is_known():
    assert RESULTS.mean("iou_mean") == pytest.approx(0.6)
    assert RESULTS.mean("frames_lost") == 2
    assert RESULTS.mean("bop_ar") is None


def test_a_file_gives_back_what_was_written(tmp_path):
    write_results(RESULTS, tmp_path / "new/results.json")
    assert read_results(tmp_path / "new/results.json") == RESULTS
    document = json.loads((tmp_path / "new/results.json").read_text())
    assert document["mean"] == {"iou_mean": pytest.approx(0.6), "frames_lost": 2}
    assert document["interval"] == {"iou_mean": pytest.approx([0.5, 0.7]), "frames_lost": None}
    del document["interval"]  # files from before have none
    (tmp_path / "old.json").write_text(json.dumps(document))
    assert read_results(tmp_path / "old.json") == RESULTS


def of(values):
    return ResultSet("mine", "standard", {f"s{n}": {"iou_mean": v} for n, v in enumerate(values)}, {}, {})


def test_an_interval_of_coin_tosses_is_the_binomial_distributions():
    low, high = of([0.0, 1.0] * 12).interval("iou_mean")
    # Means of 24 tosses: 95 % lie from 7 to 17 heads.
    assert (low, high) == pytest.approx((7 / 24, 17 / 24), abs=1 / 24)
    assert of([0.0, 1.0] * 12).interval("iou_mean") == (low, high)
    assert of([0.5, 0.5]).interval("iou_mean") == (0.5, 0.5)


def test_more_sequences_make_an_interval_narrower():
    widths = [np.ptp(of([0.2, 0.9, 0.4] * count).interval("iou_mean")) for count in (1, 4, 16)]
    assert widths[0] > 1.5 * widths[1] > 2.2 * widths[2]


def test_there_is_no_interval_of_one_sequence_or_of_the_infinite():
    assert of([0.5]).interval("iou_mean") is None
    assert of([]).interval("iou_mean") is None
    assert of([0.5, float("inf")]).interval("iou_mean") is None


REFINED = ResultSet(
    "mine", "standard", SCORES, {"c": "it crashed"}, {}, {"a": {"iou_mean": 0.4, "frames_lost": 3}}
)


def test_causal_and_refined_answers_are_two_sets_of_results():
    causal, refined = REFINED.split()
    assert (causal.label, refined.label) == ("mine, causal", "mine, refined")
    # Nothing of b was refined: its only answers are both.
    assert causal.values("iou_mean") == {"a": 0.4, "b": 0.7}
    assert refined.values("iou_mean") == {"a": 0.5, "b": 0.7}
    assert [one.causal for one in (causal, refined)] == [{}, {}]
    assert RESULTS.split() == [RESULTS]


def test_a_file_gives_back_causal_answers_too_and_files_from_before_have_none(tmp_path):
    write_results(REFINED, tmp_path / "results.json")
    assert read_results(tmp_path / "results.json") == REFINED
    document = json.loads((tmp_path / "results.json").read_text())
    del document["causal"]
    (tmp_path / "results.json").write_text(json.dumps(document))
    assert read_results(tmp_path / "results.json").causal == {}


def test_scores_of_jobs_are_told_apart_by_what_they_score():
    outcome = JobOutcome(SimpleNamespace(sequence="a"), {"iou_mean": 0.9, "causal": {"iou_mean": 0.8}})
    plain = JobOutcome(SimpleNamespace(sequence="b"), {"iou_mean": 0.6, "causal": None})
    lost = JobOutcome(SimpleNamespace(sequence="c"), None, "it crashed")
    variant = Variant(label="mine", config=load_config())
    found = collect(variant, Dataset("real", None, "clip", Path(), ("a", "b", "c")), [outcome, plain, lost])
    assert found.scores == {"a": {"iou_mean": 0.9}, "b": {"iou_mean": 0.6}, "c": None}
    assert found.causal == {"a": {"iou_mean": 0.8}}


@pytest.mark.parametrize(
    ("value", "measure", "text"),
    [
        (0.1234, "share_lost", "0.123"),
        (0.1234, "share_under_5_deg", "0.123"),
        (2.34, "rotation_error_return_deg", "2.3"),
        (643.21, "peak_memory_mb", "643.2"),
        (3.5, "frames_lost", "3.5"),
        (None, "iou_mean", "-"),
    ],
)
def test_figures_have_as_many_digits_as_they_are_worth(value, measure, text):
    assert figure(value, measure) == text


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "other"}', '{"format": "tracking3d-results"}'])
def test_another_file_is_refused_by_name(tmp_path, text):
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(InputError, match=r"other\.json is not a result set"):
        read_results(tmp_path / "other.json")


def test_the_table_has_a_line_for_each_sequence_the_mean_and_its_interval():
    table = format_results(RESULTS)
    columns = {column.header: list(column.cells) for column in table.columns}
    assert columns["sequence"] == ["a", "b", "c", "mean", "95% interval"]
    assert columns["IoU"][-2:] == ["0.600", "0.500 to 0.700"]
    assert columns["lost"][-2:] == ["2.0", "-"]


def test_a_table_of_one_sequence_has_no_interval():
    assert format_results(of([0.5])).row_count == 2
