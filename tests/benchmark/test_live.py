"""A clip that is played at a camera's rate: what is taken and dropped adds up, and a slow pipeline does not lag."""

from __future__ import annotations

import json
import time
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from tracking3d.cli import app
from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.runtime.stage_times import StageTimes
from tracking3d_bench.benchmark import live
from tracking3d_bench.datasets.clip import read_truth


@pytest.fixture
def session(monkeypatch):
    """Answers after a given time; remembers the frames."""
    made = SimpleNamespace(seconds=0.0, frames=[], prompt=None)

    class Timed:
        def __init__(self, config, prompt, live):
            made.prompt = prompt

        def step(self, frame):
            made.frames.append(frame)
            time.sleep(made.seconds)
            return SimpleNamespace(stages=StageTimes(track=made.seconds))

    monkeypatch.setattr(live, "Session", Timed)
    return made


def test_a_fast_pipeline_takes_every_frame(clips, session):
    report = live.play_live(load_config(), read_truth(clips / "narrow"), seconds=0.5, rate=50)
    assert (report.played, report.taken, report.dropped) == (25, 25, 0)
    assert report.worst_lag < 0.02 and report.longest_gap == 0
    assert report.answers_per_second == pytest.approx(50, rel=0.2)
    assert report.seconds_per_frame == report.stages.track == 0
    assert session.prompt.box == tuple(read_truth(clips / "narrow").box)


def test_a_slow_pipeline_drops_frames_and_lags_by_its_own_time_only(clips, session):
    session.seconds = 0.05  # five frames
    report = live.play_live(load_config(), read_truth(clips / "narrow"), seconds=1.5, rate=100)
    assert report.taken + report.dropped == report.played == 150
    assert report.taken == len(session.frames) and 20 < report.taken < 35
    assert 0.05 <= report.median_lag < 0.08 and report.worst_lag < 0.2 and report.end_lag < 0.2
    assert report.seconds_per_frame == pytest.approx(0.05)
    assert 3 <= report.longest_gap <= 15
    assert session.frames[0].index == 0 and session.frames[-1].index == 149


def test_a_clip_is_played_to_and_fro_without_a_jump(clips):
    images = [np.full((2, 2, 3), n, np.uint8) for n in range(4)]
    shown = [int(frame.image[0, 0, 0]) for frame in islice(live._to_and_fro(images, 11), 20)]
    assert shown == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2]


@pytest.mark.parametrize(("seconds", "rate"), [(0, 15), (1, 0), (float("nan"), 15)])
def test_a_length_or_rate_that_makes_no_sense_is_refused(clips, seconds, rate):
    with pytest.raises(InputError, match="more than 0"):
        live.play_live(load_config(), read_truth(clips / "narrow"), seconds, rate)


@pytest.mark.slow
@pytest.mark.usefixtures("session")
def test_the_command_prints_what_it_found(clips):
    arguments = ["bench", "live", str(clips / "narrow"), "--seconds", "1", "--rate", "30"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert "30 at 30 Hz" in result.stdout and "dropped to keep up" in result.stdout
    document = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert document["taken"] == 30 and document["longest_gap"] == 0
