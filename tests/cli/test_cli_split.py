"""``tracking3d run --split`` and what measures it: what reaches the library, and what is said."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tracking3d.benchmark.split_benefit import Measured, looped
from tracking3d.errors import OutputError
from tracking3d.submaps.job import Ended

BOX = ("--box", "20,10,20,20")


@pytest.fixture
def parts(monkeypatch):
    """What is asked of the library, and what it answers."""
    asked, answers = [], []

    def record_in_parts(*given, **named):
        asked.append((given, named))
        answer = answers.pop()
        if isinstance(answer, BaseException):
            raise answer
        return answer

    monkeypatch.setattr("tracking3d.submaps.split_run.record_in_parts", record_in_parts)
    monkeypatch.setattr("tracking3d.cli.progress.print_summary", lambda folder: print(f"summary of {folder}"))
    return asked, answers


def test_what_is_given_reaches_the_library(call, clip, parts):
    asked, answers = parts
    answers.append(Ended((Path("run"),), 3))
    result = call(
        "run", clip, *BOX, "--split", "40f", "--workers", 3, "--out", "run", "--frames", "0:4", "--resume"
    )
    assert result.exit_code == 0, result.output
    [((_, config, folder, given), named)] = asked
    assert (folder, given.box, config.solver.name) == (Path("run"), (20, 10, 20, 20), "online")
    assert (named["length"], named["workers"], named["selection"]) == ("40f", 3, "0:4")
    assert (named["resume"], named["overwrite"]) == (True, False)
    assert "summary of run" in result.stdout
    assert result.stderr == ""


def test_parts_that_were_not_joined_are_named_with_the_reason(call, clip, parts):
    parts[1].append(
        Ended((Path("run/parts/part_0"), Path("run/parts/part_1")), 2, "parts 1 and 2: they differ")
    )
    result = call("run", clip, *BOX, "--split", "40f", "--out", "run")
    assert result.exit_code == 0, result.output
    assert "summary of run/parts/part_1" in result.stdout
    assert "they differ" in result.stderr
    assert "run/parts/part_0, run/parts/part_1" in result.stderr


def test_a_video_that_was_not_cut_says_why(call, clip, parts):
    parts[1].append(Ended((Path("run"),), 1, "clip has 5 frames, which is one part"))
    result = call("run", clip, *BOX, "--split", "40f", "--out", "run")
    assert "one part" in result.stderr


def test_what_stops_it_says_how_to_go_on(call, clip, parts, tmp_path):
    (tmp_path / "run/parts").mkdir(parents=True)
    parts[1].append(OutputError("The disk is full."))
    result = call("run", clip, *BOX, "--split", "40f", "--out", tmp_path / "run")
    assert result.exit_code == 2
    assert "The disk is full." in result.stderr
    assert "--resume" in result.stderr


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--split", "40f", "--start-frame", "2"), "--start-frame"),
        (("--split", "40f", "--correct", "2:1,1,9,9"), "--correct"),
        (("--split", "40f", "--view"), "--view"),
        (("--split", "40f", "--box", "1,1,9,9"), "one object"),
        (("--split", "40f", "--workers", "0"), "--workers"),
        (("--workers", "2"), "--split"),
        (("--split", "0"), "--split 0"),
        (("--split", "-1f"), "--split -1f"),
        (("--split", "5"), "in frames"),
        (("--split", "40f", "--no-final-refine"), "final refinement"),
        (("--split", "40f", "--quality", "draft"), "final refinement"),
    ],
)
def test_what_does_not_go_together_is_refused_in_a_sentence(options, said, call, clip):
    result = call("run", clip, *BOX, *options, "--out", "run")
    assert result.exit_code == 2
    assert said in result.stderr
    assert not Path("run").exists()


def test_a_video_is_played_to_and_fro():
    assert looped(9, 4).tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2]
    assert looped(3, 1).tolist() == [0, 0, 0]


def test_the_benefit_is_told_side_by_side(call, monkeypatch):
    def measured(config, folder, **named):
        assert (named["frames"], named["length"], named["size"]) == (100, 50, (320, 240))
        return {
            "whole": Measured(100.0, 2.0, 1.5, 1.0, {}),
            "split": Measured(60.0, 2.1, 1.6, 0.9, {"join": 5.0}, 2),
        }

    monkeypatch.setattr("tracking3d.benchmark.split_benefit.measure_split", measured)
    result = call("bench", "split", "--frames", 100)
    assert result.exit_code == 0, result.output
    for word in ("0.60", "2.10", "90%", "join"):
        assert word in result.stdout
    printed = json.loads(call("bench", "split", "--frames", 100, "--json").stdout)
    assert printed["split"]["stages"] == {"join": 5.0}


def test_a_fleet_is_simulated_and_drawn(call, tmp_path):
    pytest.importorskip("matplotlib")
    options = ("--videos", 60, "--workers", 5, "--part", 30)
    result = call("bench", "schedule", *options, "--plot", tmp_path / "plot.png")
    assert result.exit_code == 0, result.output
    assert "longest first, split" in result.stdout
    assert (tmp_path / "plot.png").stat().st_size > 5000
    printed = json.loads(call("bench", "schedule", *options, "--json").stdout)
    assert len(printed) == 6
    assert len(json.loads(call("bench", "schedule", *options, "--part", 0, "--json").stdout)) == 3


def test_costs_of_a_run_that_is_none_are_refused(call, tmp_path):
    result = call("bench", "cost", tmp_path)
    assert result.exit_code == 2
    assert "not a run folder" in result.stderr
