"""Modules that moved into tracking3d-bench, and others, under their former names."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module

import pytest

import tracking3d_bench.evaluation.metrics
import tracking3d_bench.vot
from tracking3d.cli import plugged_commands
from tracking3d.errors import InputError

FORMER = {
    "tracking3d.benchmark.compare": "MeasureComparison compare interval",
    "tracking3d.benchmark.results": "ResultSet read_results write_results",
    "tracking3d.benchmark.suite": "run_suite",
    "tracking3d.benchmark.tables": "TABLES",
    "tracking3d.benchmark.variant": "Variant",
    "tracking3d.datasets.answers": "Answers PointTracker",
    "tracking3d.datasets.bop_export": "write_bop",
    "tracking3d.datasets.clip": "Truth read_truth write_clip",
    "tracking3d.datasets.layout": "DatasetLayout builtin_layouts load_layout",
    "tracking3d.datasets.readers": "read_answers",
    "tracking3d.datasets.reading": "list_sequences read_sequence",
    "tracking3d.datasets.run_answers": "answers_of_run",
    "tracking3d.datasets.truth": "DepthFile MaskFile MaskReference MeshFile PointTruth Truth",
    "tracking3d.evaluation.alignment": """ObjectAlignment align_object_frame align_on_frame translation_errors""",
    "tracking3d.evaluation.bop": "add adi average_recall model_diameter mspd mssd",
    "tracking3d.evaluation.boundary": "boundary_f davis_jaccard davis_statistics",
    "tracking3d.evaluation.calibration": "detection_scores expected_calibration_error reliability",
    "tracking3d.evaluation.shape": "shape_scores",
    "tracking3d.evaluation.sources": "open_answers",
    "tracking3d.evaluation.tapvid": "tapvid_scores to_tapvid_raster",
    "tracking3d.evaluation.vot": "long_term_scores rectangle_overlap",
    "tracking3d.evaluation.vsd": "vsd",
    "tracking3d.evaluation.metrics": """aligned_rotation_errors anchored_rotation_errors
        consecutive_rotation_errors mask_iou rotation_alignment share_under""",
    "tracking3d.evaluation.score": "Scores score score_run",
    "tracking3d.synthesis.mask_degradation": "Faults degrade_to_iou",
    "tracking3d.synthesis.spec": "Disturbances SequenceSpec",
    "tracking3d.synthesis.suite": "SUITES SUITE_VERSION load_suite make_suite",
    "tracking3d.vot": "VotTracker",
    "tracking3d.config.solvers": "KeyframeConfig LearningRates OnlineConfig PaperConfig TrackingWeights LossWeights",
    "tracking3d.networks.download": "adopt fetch",
    "tracking3d.networks.session": "Network TensorInfo",
    "tracking3d.networks.store": "find_network",
    "tracking3d.prompts.corrections": "Correction parse_correction",
    "tracking3d.prompts.points": "parse_points points_prompt",
    "tracking3d.prompts.prompt": "PromptSet make_prompt parse_box",
    "tracking3d.report.comparison": "write_comparison",
    "tracking3d.report.differences": "Difference RunComparison compare_runs",
    "tracking3d.report.run_report": "write_report",
    "tracking3d.report.several": "write_reports",
    "tracking3d.synthesis.convex_clips": """SyntheticClip SyntheticSpec degrade_masks make_demo_clip
        synthesize""",
}
"""Public names of the package before its rooms moved; removed after the next version at the earliest."""

MOVED = {name.split(".")[1] for name in FORMER} - {"config"} | {"speed"}


@pytest.fixture(autouse=True)
def not_imported_yet(monkeypatch):
    """A former name that another test has imported would not warn again."""
    for name in [name for name in sys.modules if name.startswith("tracking3d.")]:
        if name.split(".")[1] in MOVED or name == "tracking3d.config.solvers":
            monkeypatch.delitem(sys.modules, name)


def test_a_former_name_is_the_same_module_and_names_the_present_one():
    with pytest.warns(DeprecationWarning, match=r"has moved: use tracking3d_bench\.evaluation\.metrics\."):
        former = import_module("tracking3d.evaluation.metrics")
    assert former is tracking3d_bench.evaluation.metrics
    assert former.__spec__.name == "tracking3d_bench.evaluation.metrics"


@pytest.mark.filterwarnings("ignore:tracking3d")
@pytest.mark.parametrize(("module", "names"), FORMER.items())
def test_what_was_public_is_there_under_its_former_name(module, names):
    assert [name for name in names.split() if not hasattr(import_module(module), name)] == []


def test_what_plug_ins_import_needs_no_second_distribution(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("tracking3d_bench")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_NotInstalled(), *sys.meta_path])
    with pytest.warns(DeprecationWarning, match=r"use tracking3d\.trackers\.region_files"):
        assert import_module("tracking3d.datasets.region_files").read_regions
    with (
        pytest.warns(DeprecationWarning),
        pytest.raises(ImportError, match=r"layout is part of tracking3d-bench, which is not installed"),
    ):
        import_module("tracking3d.datasets.layout")


def test_the_trackers_in_the_files_of_vot_users_go_on_working_with_a_notice():
    with pytest.warns(FutureWarning, match="use tracking3d_bench.vot"):
        assert import_module("tracking3d.vot").VotTracker is tracking3d_bench.vot.VotTracker
    words = [sys.executable, "-m", "tracking3d.vot.trax_server", "--help"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and "--preset" in ended.stdout
    assert "tracking3d.vot has moved: use tracking3d_bench.vot" in ended.stderr


class _NotInstalled:
    def find_spec(self, name, path, target=None):
        if name == "tracking3d_bench":
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)


def test_a_former_name_can_be_run():
    code = "import runpy; runpy.run_module('tracking3d.speed.kernels_ahead', run_name='once')"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


def test_a_module_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'tracking3d\.evaluations'"):
        import_module("tracking3d.evaluations")


@pytest.mark.parametrize("command", ["evaluate", "synth", "bench"])
def test_without_it_a_command_that_measures_says_where_it_is(command, monkeypatch):
    monkeypatch.setattr(plugged_commands.metadata, "entry_points", lambda **given: ())
    with pytest.raises(InputError, match=r"pip install -c constraints\.txt \./plugins/tracking3d-bench"):
        plugged_commands.plugged_command(command)
    assert plugged_commands.plugged_command("track") is None
