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


@pytest.fixture(autouse=True)
def not_imported_yet(monkeypatch):
    """A former name that another test has imported would not warn again."""
    for name in [name for name in sys.modules if name.startswith("tracking3d.")]:
        if name.split(".")[1] in {"benchmark", "datasets", "evaluation", "speed", "vot"}:
            monkeypatch.delitem(sys.modules, name)
    yield
    for name in ("tracking3d.evaluation.metrics", "tracking3d.datasets.region_files", "tracking3d.vot"):
        sys.modules.pop(name, None)


def test_a_former_name_is_the_same_module_and_names_the_present_one():
    with pytest.warns(DeprecationWarning, match=r"has moved: use tracking3d_bench\.evaluation\.metrics\."):
        former = import_module("tracking3d.evaluation.metrics")
    assert former is tracking3d_bench.evaluation.metrics
    assert former.__spec__.name == "tracking3d_bench.evaluation.metrics"


def test_what_plug_ins_import_needs_no_second_distribution(monkeypatch):
    monkeypatch.setitem(sys.modules, "tracking3d_bench", None)
    with pytest.warns(DeprecationWarning, match=r"use tracking3d\.trackers\.region_files"):
        assert import_module("tracking3d.datasets.region_files").read_regions
    with (
        pytest.warns(DeprecationWarning),
        pytest.raises(ImportError, match=r"tracking3d-bench|tracking3d_bench"),
    ):
        import_module("tracking3d.datasets.layout")


def test_the_trackers_in_the_files_of_vot_users_go_on_working_with_a_notice():
    with pytest.warns(FutureWarning, match="use tracking3d_bench.vot"):
        assert import_module("tracking3d.vot").VotTracker is tracking3d_bench.vot.VotTracker
    words = [sys.executable, "-m", "tracking3d.vot.trax_server", "--help"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 0 and "--preset" in ended.stdout
    assert "tracking3d.vot has moved: use tracking3d_bench.vot" in ended.stderr


def test_a_module_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match="No module named 'tracking3d.evaluations'"):
        import_module("tracking3d.evaluations")


@pytest.mark.parametrize("command", ["evaluate", "synth", "bench"])
def test_without_it_a_command_that_measures_says_where_it_is(command, monkeypatch):
    monkeypatch.setattr(plugged_commands.metadata, "entry_points", lambda **given: ())
    with pytest.raises(InputError, match=r"pip install -c constraints\.txt \./plugins/tracking3d-bench"):
        plugged_commands.plugged_command(command)
    assert plugged_commands.plugged_command("track") is None
