"""``tracking3d run --split``: what reaches the library, and what is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from tracking3d.errors import OutputError
from tracking3d.pipeline.submaps.job import SplitResult

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

    monkeypatch.setattr("tracking3d.pipeline.submaps.split_run.record_in_parts", record_in_parts)
    monkeypatch.setattr("tracking3d.cli.summary.print_summary", lambda folder: print(f"summary of {folder}"))
    return asked, answers


def test_what_is_given_reaches_the_library(call, clip, parts):
    asked, answers = parts
    answers.append(SplitResult((Path("run"),), 3))
    result = call(
        "run", clip, *BOX, "--split", "40f", "--workers", 3, "--out", "run", "--frames", "0:4", "--resume"
    )
    assert result.exit_code == 0, result.output
    [((_, config, folder, given), named)] = asked
    assert (folder, list(given.boxes), config.solver.name) == (Path("run"), [(20, 10, 20, 20)], "online")
    assert (named["length"], named["workers"], named["selection"]) == ("40f", 3, "0:4")
    assert (named["resume"], named["overwrite"]) == (True, False)
    assert "summary of run" in result.stdout
    assert result.stderr == ""


def test_parts_that_were_not_joined_are_named_with_the_reason(call, clip, parts):
    parts[1].append(
        SplitResult((Path("run/parts/part_0"), Path("run/parts/part_1")), 2, "parts 1 and 2: they differ")
    )
    result = call("run", clip, *BOX, "--split", "40f", "--out", "run")
    assert result.exit_code == 0, result.output
    assert "summary of run/parts/part_1" in result.stdout
    assert "they differ" in result.stderr
    assert "run/parts/part_0, run/parts/part_1" in result.stderr


def test_a_video_that_was_not_cut_says_why(call, clip, parts):
    parts[1].append(SplitResult((Path("run"),), 1, "clip has 5 frames, which is one part"))
    result = call("run", clip, *BOX, "--split", "40f", "--out", "run")
    assert "one part" in result.stderr
    assert "--split is for long videos" in result.stderr


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
