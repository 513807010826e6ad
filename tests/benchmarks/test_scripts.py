"""The scripts of ``benchmarks/``: what reaches what measures, what is printed, and how they end."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from batch import batch
from batch_passes import ABORTING, DAMAGED, Pass
from cost import cost
from looped_run import Sample, SoakReport, Trend
from schedule import schedule
from script import as_program
from soak import soak
from split import split
from split_benefit import SplitMeasurement, looped

FOLDER = Path(__file__).resolve().parents[2] / "plugins/tracking3d-bench/benchmarks"
SCRIPTS = (
    "batch",
    "cost",
    "first_answers",
    "keypoint_matches",
    "render",
    "run_passes",
    "same_answers",
    "schedule",
    "soak",
    "split",
)


def options_of(name: str) -> set[str]:
    """Long options of a script."""
    module = importlib.import_module(name)
    if name == "same_answers":
        return {text for action in module.options()._actions for text in action.option_strings}
    command = typer.main.get_command(as_program(getattr(module, name)))
    return {text for parameter in command.params for text in (*parameter.opts, *parameter.secondary_opts)}


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_readme_names_every_script_and_option(name):
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    section = re.search(rf"^## {name}\n.*?(?=^## |\Z)", page, re.M | re.S)
    assert section, f"benchmarks/README.md has no section on {name}"
    assert f"python benchmarks/{name}.py" in section[0]
    options = {option for option in options_of(name) if option.startswith("--")} - {"--help"}
    assert options and {option for option in options if f"`{option}" not in section[0]} == set()


def test_a_script_runs_from_any_folder_without_an_installation(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(FOLDER.parent)}
    words = [sys.executable, str(FOLDER / "cost.py"), str(tmp_path)]
    ended = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    [line] = ended.stderr.splitlines()
    assert line.startswith("error: ") and "not a run folder" in line


def test_a_video_is_played_to_and_fro():
    assert looped(9, 4).tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    assert looped(3, 1).tolist() == [0, 0, 0]


def test_the_benefit_is_told_side_by_side(call, monkeypatch):
    def measured(config, folder, **named):
        assert (named["frames"], named["length"], named["size"]) == (100, 50, (320, 240))
        return {
            "whole": SplitMeasurement(100.0, 2.0, 1.5, 1.0, {}),
            "split": SplitMeasurement(60.0, 2.1, 1.6, 0.9, {"join": 5.0}, 2),
        }

    monkeypatch.setattr("split_benefit.measure_split", measured)
    result = call(split, "--frames", 100)
    assert result.exit_code == 0, result.output
    for word in ("0.60", "2.10", "90%", "join"):
        assert word in result.stdout
    printed = json.loads(call(split, "--frames", 100, "--json").stdout)
    assert printed["split"]["stages"] == {"join": 5.0}


def test_a_fleet_is_simulated_and_drawn(call, tmp_path):
    pytest.importorskip("matplotlib")
    options = ("--videos", 60, "--workers", 5, "--part", 30)
    result = call(schedule, *options, "--plot", tmp_path / "plot.png")
    assert result.exit_code == 0, result.output
    assert "longest first, split" in result.stdout
    assert (tmp_path / "plot.png").stat().st_size > 5000
    printed = json.loads(call(schedule, *options, "--json").stdout)
    assert len(printed) == 6
    assert len(json.loads(call(schedule, *options, "--part", 0, "--json").stdout)) == 3


def test_costs_of_a_run_that_is_none_are_refused(call, tmp_path):
    result = call(cost, tmp_path)
    assert result.exit_code == 2
    assert "not a run folder" in result.stderr


@pytest.mark.parametrize(("flat", "code"), [(True, 0), (False, 1)])
def test_a_soak_in_which_something_grows_fails(call, monkeypatch, flat, code):
    sample = Sample(0, 0.1, 100.0, 12, "tracked")
    report = SoakReport(1, 0, {"tracked": 1}, {"memory": Trend(100.0, 120.0, 100.0, 120.0, flat)}, [sample])
    monkeypatch.setattr("looped_run.track_looped", lambda *_: report)
    result = call(soak, "--frames", 1)
    assert result.exit_code == code, result.output
    assert ("flat" if flat else "grows") in result.stdout
    assert json.loads(call(soak, "--frames", 1, "--json").stdout)["flat"] is flat


@pytest.mark.parametrize(
    ("failed", "different", "code"),
    [
        ({DAMAGED: "no frame", ABORTING: "signal 6"}, 0.0, 0),
        ({"clip_0001": "it was killed"}, 0.0, 1),
        ({}, 0.1, 1),
    ],
)
def test_a_batch_fails_if_a_fault_costs_another_video_or_poses_differ(
    call, monkeypatch, failed, different, code
):
    figures = dict.fromkeys(
        (
            "memory",
            "own_memory",
            "descriptors",
            "own_descriptors",
            "processes",
            "shared_memory",
            "unfinished",
        ),
        3.0,
    )
    passes = [
        Pass("workers_1", 1, 20.0, 4, {}, 2.0, 0.0, ()),
        Pass("workers_2", 2, 10.0, 4, failed, 4.0, different, (), figures, figures),
    ]
    monkeypatch.setattr("batch_passes.demonstrate", lambda *_: passes)
    result = call(batch, "--clips", 4)
    assert result.exit_code == code, result.output
    assert "2.00 times as fast" in result.stdout
    assert "+3.0 open files in all" in result.stdout
    for video, reason in failed.items():
        assert f"workers_2, {video}: {reason}" in result.stdout
    assert [one["label"] for one in json.loads(call(batch, "--json").stdout)] == ["workers_1", "workers_2"]
