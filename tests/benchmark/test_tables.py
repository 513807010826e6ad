"""The paper's tables: its figures add up, every row runs what it says, and ours stand in the right cells."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d_bench.benchmark import paper_numbers, table, tables
from tracking3d_bench.benchmark.results import ResultSet
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.table import fill, format_table, to_csv, to_json, to_markdown, write_table
from tracking3d_bench.benchmark.table_plot import plot_table
from tracking3d_bench.benchmark.tables import LOSSES, TABLES
from tracking3d_bench.benchmark.variant import Variant

BASE = Variant(label="default", config=load_config(preset="rerendering"))
SUITE = Dataset("standard", 1, "clip", Path("nowhere"), ("01_box", "05_card_flip"))
REAL = Dataset("cdtb", None, "cdtb", Path("nowhere"), tuple(f"s{n:02}" for n in range(40)))
IOU = {"OSTrack": 0.8, "CSR-DCF": 0.5}


@pytest.fixture
def asked(monkeypatch):
    """What is asked to be run; every variant starts from an IoU of 0.7 and ends with that in `IOU`, or 0.77."""
    calls = []

    def run(variants, dataset, out, processes, listener, address=None):
        calls.append((list(variants), dataset))
        return [
            ResultSet(
                variant.label,
                dataset.name,
                {
                    name: {
                        "iou_initial_mean": 0.7,
                        "iou_mean": IOU.get(variant.label, 0.77),
                        "iou_gain_percent": 10.0 if "box" in name else -1.0,
                        "bop_ar": 0.4,
                        "rotation_error_mean_deg": 3.0,
                        "seconds_per_frame": 0.5,
                    }
                    for name in dataset.sequences
                },
                {},
                {},
            )
            for variant in variants
        ]

    monkeypatch.setattr(table, "run_suite", run)
    return calls


def lines(filled):
    return {line.label: line for line in filled.lines}


@pytest.mark.parametrize(
    ("start", "rows"),
    [
        ("CSR-DCF", paper_numbers.CDTB),
        ("Coin tracking", paper_numbers.COIN),
        ("initial masks (OSTrack)", paper_numbers.ABLATION),
    ],
)
def test_the_gains_that_the_paper_prints_are_those_of_its_ious(start, rows):
    for name, row in rows.items():
        if row.gain is not None:
            of = rows.get(name.removesuffix(" + ours"), rows.get(start)) if "+ ours" in name else rows[start]
            assert row.gain == pytest.approx(100 * (row.value / of.value - 1), abs=0.06), name


@pytest.mark.parametrize("name", TABLES)
def test_every_row_is_the_papers_or_is_planned(name):
    plan = TABLES[name].plan(BASE, True, {})
    rows = TABLES[name].rows
    assert all(row.paper or row.plan for row in rows)
    assert {row.plan for row in rows if row.plan} == set(plan)


def test_an_initial_tracker_is_its_likeness_where_the_data_are_synthetic(asked, tmp_path):
    filled = fill(TABLES["cdtb"], BASE, SUITE, tmp_path)
    [(variants, _)] = asked
    assert [variant.masks for variant in variants] == [
        "degraded:0.498",
        "degraded:0.732",
        "degraded:0.758",
        "tracker",
    ]
    row = lines(filled)["OSTrack + ours"]
    assert (row.paper, row.paper_gain_percent, row.here) == (0.788, 4.0, pytest.approx(0.8))
    assert row.gain_percent == pytest.approx(100 * (0.8 / 0.7 - 1))
    assert (row.rotation_error_mean_deg, row.seconds_per_frame, row.sequences) == (3.0, 0.5, 2)
    assert lines(filled)["OSTrack"].here == pytest.approx(0.7)
    assert "synthetic suite standard, version 1 (2 sequences)" in filled.caption
    assert {path.name for path in (tmp_path / "results").iterdir()} == {
        "cdtb-csr_dcf-standard.json",
        "cdtb-csrt-standard.json",
        "cdtb-d3s-standard.json",
        "cdtb-ostrack-standard.json",
    }


def test_on_real_data_a_tracker_without_masks_says_what_it_needs(asked, tmp_path):
    filled = fill(TABLES["cdtb"], BASE, REAL, tmp_path, initial={"d3s": tmp_path})
    [(variants, dataset)] = asked
    assert [(variant.label, variant.masks) for variant in variants] == [
        ("csrt of this package", "tracker"),  # stands for CSR-DCF
        ("D3S", str(tmp_path)),
        ("csrt of this package", "tracker"),
    ]
    assert lines(filled)["OSTrack + ours"].note == "needs the masks of OSTrack: --initial ostrack=DIR"
    assert lines(filled)["OSTrack + ours"].here is None
    assert lines(filled)["CSR-DCF + ours"].here == pytest.approx(0.77)
    assert "synthetic" not in filled.caption
    assert len(dataset.sequences) == 40


def test_the_ablation_draws_sixteen_sequences_and_always_the_same(asked, tmp_path):
    for _ in range(2):
        fill(TABLES["ablation"], BASE, REAL, tmp_path, initial={"ostrack": tmp_path})
    (_, first), (_, second) = asked
    assert len(first.sequences) == 16 and first == second


def test_each_ablated_row_differs_from_the_full_one_by_its_loss_only(asked, tmp_path):
    fill(TABLES["ablation"], BASE, SUITE, tmp_path)
    variants = {variant.label: variant for variant in asked[0][0]}
    full = variants["RGB"].config.model_dump()
    for label, settings in LOSSES.items():
        weights = {key.rpartition("__")[2]: value for key, value in settings.items()}
        expected = {**full["solver"]["weights"], **weights}
        config = variants[label].config.model_dump()
        assert config["solver"]["weights"] == expected
        config["solver"]["weights"] = full["solver"]["weights"]
        assert config == full


@pytest.mark.parametrize("table", ["ablation", "keyframes"])
def test_what_only_the_papers_solver_has_is_not_changed_in_another(asked, tmp_path, table):
    online = Variant(label="default", config=load_config())
    filled = fill(TABLES[table], online, SUITE, tmp_path)
    assert all("solver paper: --preset rerendering" in line.note for line in filled.lines if line.paper)
    assert asked[0][0] == []


def test_deep_features_that_are_not_installed_are_said_to_be(asked, tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "DEEP", "no_such_encoder")
    assert "not installed" in lines(fill(TABLES["coin"], BASE, SUITE, tmp_path))["S2DNet"].note


def test_the_coin_table_runs_flat_objects_only(asked, tmp_path):
    fill(TABLES["coin"], BASE, SUITE, tmp_path)
    [(variants, dataset)] = asked
    assert dataset.sequences == ("05_card_flip",)
    runs = [(variant.config.features.name, variant.config.object.flat) for variant in variants]
    assert runs == [("rgb", False), ("rgb", True), ("s2dnet", False), ("s2dnet", True)]


def test_the_features_table_runs_every_tracker_with_both_features_and_both_priors(asked, tmp_path):
    filled = fill(TABLES["features"], BASE, SUITE, tmp_path)
    runs = {
        (v.masks, v.config.tracker.name, v.config.features.name, v.config.object.flat) for v in asked[0][0]
    }
    assert len(runs) == 4 * 2 * 2
    assert lines(filled)["flow, initial masks"].here == pytest.approx(0.7)
    assert lines(filled)["true masks, S2DNet, flat prior"].here == pytest.approx(0.77)


def test_only_the_rows_that_are_asked_for_are_run(asked, tmp_path):
    filled = fill(TABLES["features"].only(["csrt, RGB", "csrt, S2D*prior"]), BASE, SUITE, tmp_path)
    assert list(lines(filled)) == ["csrt, RGB", "csrt, S2DNet, flat prior"]
    assert [variant.label for variant in asked[0][0]] == list(lines(filled))
    with pytest.raises(InputError, match=r"Table features has no row 'nonsense'; choose from: csrt, initial"):
        TABLES["features"].only(["csrt, RGB", "nonsense"])


def test_one_to_ten_keyframes_are_run(asked, tmp_path):
    fill(TABLES["keyframes"], BASE, SUITE, tmp_path)
    assert [variant.config.solver.keyframes.maximum for variant in asked[0][0]] == list(range(1, 11))


def test_the_pose_table_shows_average_recall(asked, tmp_path):
    row = lines(fill(TABLES["bop"], BASE, SUITE, tmp_path))["ours, OSTrack"]
    assert (row.paper, row.here, row.gain_percent) == (0.545, pytest.approx(0.4), None)


def test_a_table_is_the_same_in_every_format(asked, tmp_path):
    filled = fill(TABLES["ablation"], BASE, SUITE, tmp_path)
    document = json.loads(to_json(filled))
    rows = list(csv.DictReader(io.StringIO(to_csv(filled))))
    assert [row["label"] for row in rows] == [row["label"] for row in document["lines"]]
    assert float(rows[1]["here"]) == document["lines"][1]["here"]
    markdown = to_markdown(filled)
    assert markdown.startswith(filled.caption)
    assert "| no L_M | 0.6890 | -2.0 | 0.7700 | +10.0 | 3.0 | 0.50 | 2 | 1 |  |" in markdown
    assert format_table(filled).row_count == len(rows)
    assert {file.suffix for file in write_table(filled, tmp_path / "t")} == {".md", ".csv", ".json"}


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_a_table_is_drawn_the_same_every_time(asked, tmp_path, suffix):
    pytest.importorskip("matplotlib", reason="the extra plots is not installed")
    filled = fill(TABLES["keyframes"], BASE, SUITE, tmp_path)
    for name in ("one", "two"):
        plot_table(filled, tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"one{suffix}").read_bytes() == (tmp_path / f"two{suffix}").read_bytes()
