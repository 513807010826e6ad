"""How fast a clip is tracked end to end: what a command took, side by side, as tables, figures and a picture."""

from __future__ import annotations

import json

import pytest
from rich.console import Console
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.errors import InputError, OutputError
from tracking3d.runtime.stage_times import STAGES, StageTimes
from tracking3d_bench.benchmark import track_speed
from tracking3d_bench.benchmark.track_speed import Contender, TrackSpeed, as_figures, check_out
from tracking3d_bench.benchmark.track_speed_table import plot_stages, speed_table, stage_table


def speed(name: str, factor: float, refinement: float | None = 0.1) -> TrackSpeed:
    stages = StageTimes(track=0.1 * factor, solve=0.3 * factor)
    frames = tuple(tuple(getattr(stages, stage) for stage in STAGES) for _ in range(10))
    return TrackSpeed(
        name, 10, 9.0, None, 2.0, 2.5 / factor, (0.4 * factor,) * 3, stages, refinement, 500.0, frames
    )


def printed(table) -> str:
    console = Console(width=200)
    with console.capture() as captured:
        console.print(table)
    return captured.get()


def test_contenders_stand_side_by_side_and_say_how_many_times_slower_they_are():
    text = printed(speed_table([speed("this version", 1.0), speed("preset paper", 40.0, None)]))
    rows = {line[:34].strip(): line[34:].split() for line in text.splitlines()}
    assert rows["frames a second, after the first"] == ["2.50", "0.06"]
    assert rows["times that of the first column"] == ["1.00", "40.00"]
    assert rows["final refinement, a frame, s"] == ["0.100", "-"]
    assert rows["of all processors, s"] == ["-", "-"]


def test_stages_have_shares_that_make_up_the_whole():
    text = printed(stage_table([speed("this version", 1.0)]))
    assert "100.0  25%" in text and "300.0  75%" in text and "400.0" in text


def test_figures_are_plain_values():
    one, other = json.loads(json.dumps(as_figures([speed("a", 1.0), speed("b", 3.0)])))
    assert one["ratio"] == 1 and other["ratio"] == pytest.approx(3)
    assert one["delay"] == pytest.approx({"p50": 0.4, "p95": 0.4, "p100": 0.4})
    assert list(one["stages"]) == list(STAGES) and len(one["over_time"]) == 10


def test_stages_are_drawn_over_time(tmp_path):
    pytest.importorskip("matplotlib")
    slow_start = speed("a", 1.0)
    frames = ((0.0, 9.0, 0.0, 0.0, 0.0, 0.0), *slow_start.over_time[1:])
    slow = TrackSpeed(**{**vars(slow_start), "over_time": frames})
    plot_stages([slow, speed("b", 40.0)], tmp_path / "stages.svg")
    drawn = (tmp_path / "stages.svg").read_text()
    assert "<!-- 9.0 s -->" in drawn and "<!-- write -->" in drawn
    with pytest.raises(OutputError, match="cannot be written"):
        plot_stages([slow], tmp_path / "nowhere" / "stages.svg")


def test_a_version_that_git_does_not_know_is_refused(tmp_path):
    with pytest.raises(InputError, match="--against v0-never"):
        check_out("v0-never", tmp_path)


def test_an_earlier_version_is_the_one_that_runs_wherever_the_command_is_given(tmp_path, monkeypatch):
    for place in ("earlier", "here"):
        (tmp_path / place / "tracking3d").mkdir(parents=True)
        (tmp_path / place / "tracking3d" / "__init__.py").write_text("")
        (tmp_path / place / "tracking3d" / "__main__.py").write_text(f"print({place!r})")
    monkeypatch.chdir(tmp_path / "here")
    told = track_speed._python(Contender("v0", package=tmp_path / "earlier"), "tracking3d")
    assert told.stdout == "earlier\n"


def test_an_earlier_version_has_its_own_entry_points(tmp_path):
    (tmp_path / "tracking3d").mkdir()
    (tmp_path / "tracking3d" / "__init__.py").write_text("")
    (tmp_path / "tracking3d" / "__main__.py").write_text(
        "from importlib import metadata\n"
        "print([point.value for point in metadata.entry_points(group='tracking3d.trackers', name='csrt')])"
    )
    (tmp_path / "pyproject.toml").write_text(
        '[project]\nname = "tracking3d"\nversion = "0.0.1"\n'
        '[project.entry-points."tracking3d.trackers"]\ncsrt = "tracking3d.csrt:Tracker"\n'
    )
    told = track_speed._python(Contender("v0", package=tmp_path), "tracking3d")
    assert told.stdout == "['tracking3d.csrt:Tracker']\n"


def test_what_is_wrong_is_said_before_anything_runs(clips, tmp_path):
    for arguments in (["--plot", str(tmp_path / "a.txt")], ["--tracker", "nothing"], ["--set", "a.b=1"]):
        result = CliRunner().invoke(app, ["bench", "track", str(clips / "narrow"), *arguments])
        assert result.exit_code == 2 and len(result.output.strip().splitlines()) == 1, result.output


@pytest.mark.slow
def test_a_clip_is_tracked_by_all_contenders(clips):
    settings = ["--set", "crop.size=32", "--set", "object.frequency=2", "--no-final-refine"]
    result = CliRunner().invoke(
        app, ["bench", "track", str(clips / "narrow"), "--paper-frames", "0", "--json", *settings]
    )
    assert result.exit_code == 0, result.output
    [figures] = json.loads(result.stdout)
    assert figures["frames"] == 3 and figures["frames_per_second"] > 0
    assert figures["wall"] > figures["first_answer"] > 0 and figures["refinement_per_frame"] is None
