"""The solvers side by side: every column runs what it says, and means compare like with like."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.pipeline.track import SOLVERS
from tracking3d_bench.benchmark import solver_table
from tracking3d_bench.benchmark.results import ResultSet
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.solver_table import (
    fill,
    format_table,
    plan,
    tabulate_results,
    to_csv,
    to_json,
    to_markdown,
    write_table,
)
from tracking3d_bench.benchmark.variant import Variant

BASE = Variant(label="default", config=load_config(), masks="truth")
SUITE = Dataset("hard", 1, "clip", Path("nowhere"), ("a", "b", "c"))


def scores(rotation, seconds=1.0):
    return {"rotation_error_mean_deg": rotation, "seconds_per_frame": seconds, "iou_mean": 0.9}


PAPER = ResultSet("paper, RGB", "hard", {"a": scores(10.0), "b": scores(20.0), "c": scores(90.0)}, {}, {})
ONLINE = ResultSet(
    "online, RGB",
    "hard",
    {"a": scores(1.0, 0.2), "b": scores(2.0, 0.2), "c": None},
    {"c": "it crashed"},
    {},
    {"a": scores(3.0, 0.05), "b": scores(5.0, 0.05)},
)


@pytest.fixture
def both(monkeypatch):
    monkeypatch.setitem(SOLVERS, "online", object)


@pytest.fixture
def table():
    return tabulate_results([PAPER, ONLINE], "caption")


@pytest.mark.usefixtures("both")
def test_the_columns_differ_by_solver_and_features_and_the_paper_has_nothing_that_came_later():
    base = BASE.with_changes("x", solver__final_refine=True, solver__tracker_feedback=True)
    variants = plan(base)
    assert list(variants) == ["paper, RGB", "paper, S2DNet", "online, RGB", "online, S2DNet"]
    found = {
        label: (one.config.solver.name, one.config.features.name, one.config.solver.final_refine)
        for label, one in variants.items()
    }
    assert found["paper, RGB"] == ("paper", "rgb", False) and found["online, RGB"] == ("online", "rgb", True)
    assert found["paper, S2DNet"] == ("paper", "s2dnet", False)
    assert not variants["paper, RGB"].config.solver.tracker_feedback
    assert variants["online, RGB"].config.solver.tracker_feedback
    assert {one.masks for one in variants.values()} == {"truth"}


def test_a_solver_that_is_not_there_is_said_to_be_missing(monkeypatch, tmp_path):
    monkeypatch.delitem(SOLVERS, "online", raising=False)
    monkeypatch.setattr(solver_table, "run_suite", lambda variants, *rest: [PAPER] * len(variants))
    filled = fill(BASE, SUITE, tmp_path, ["*RGB"])
    assert filled.columns == ("paper, RGB",)
    assert filled.notes == ("online, RGB: there is no solver online.",)
    with pytest.raises(InputError, match="no row 'nonsense'; choose from: paper, RGB"):
        fill(BASE, SUITE, tmp_path, ["nonsense"])


def test_refined_and_causal_answers_are_columns_of_their_own(table):
    assert table.columns == ("paper, RGB", "online, RGB, causal", "online, RGB, refined")
    figures = table.figures["rotation_error_mean_deg"]
    assert figures["online, RGB, causal"] == {"a": 3.0, "b": 5.0}
    assert figures["online, RGB, refined"] == {"a": 1.0, "b": 2.0}


def test_means_are_over_the_sequences_that_every_column_has(table):
    # c was lost by `paper` and crashed in `online`: it may not count for one of them only.
    assert table.common("rotation_error_mean_deg") == ["a", "b"]
    means = [table.mean("rotation_error_mean_deg", column) for column in table.columns]
    assert means == pytest.approx([15.0, 4.0, 1.5])
    assert table.mean("bop_ar", "paper, RGB") is None
    assert "online, RGB failed on c." in table.notes


def test_speed_is_a_ratio_to_the_paper_with_the_same_features(table):
    assert [table.speed(column) for column in table.columns] == pytest.approx([1, 20, 5])
    assert tabulate_results([ONLINE], "").speed("online, RGB, causal") is None


def test_a_measure_that_nobody_has_is_not_shown(table):
    assert "bop_ar" not in table.measures and "iou_mean" in table.measures


def test_every_format_tells_the_same(table, tmp_path):
    rows = list(csv.DictReader(io.StringIO(to_csv(table))))
    refined = [row for row in rows if row["column"].endswith("refined") and row["measure"].startswith("rot")]
    assert {row["sequence"]: float(row["value"]) for row in refined} == {"a": 1.0, "b": 2.0}
    document = json.loads(to_json(table))
    assert document["means"]["rotation_error_mean_deg"]["online, RGB, refined"] == 1.5
    markdown = to_markdown(table)
    assert "| rotation error, mean ° | 15.0 | 4.0 | 1.5 | 2 |" in markdown
    assert "| times as fast as paper | 1.0 | 20.0 | 5.0 | 2 |" in markdown
    assert "| c | 90.0 | - | - |" in markdown
    assert {one.row_count for one in format_table(table)[1:]} == {4}
    assert {file.suffix for file in write_table(table, tmp_path / "new")} == {".md", ".csv", ".json"}
