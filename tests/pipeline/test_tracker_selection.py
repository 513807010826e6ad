"""The tracker ``auto``: the best that is there and can be afforded, and a sentence that says why."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from refining_solver import StandInSolver

import tracking3d
from tracking3d import load_config
from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.networks.store import VARIABLE
from tracking3d.pipeline import tracker_selection
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.pipeline.tracker_selection import CANDIDATES, check_tracker_options, choose_tracker
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.csrt import CsrtTracker
from tracking3d.trackers.segment.tracker import SegmentTracker
from tracking3d.video import open_source

FIRST = Frame(0, np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8))
PROMPT = Prompt((20.0, 10.0, 20.0, 20.0))
AUTO = load_config(tracker="auto")
NETWORKS = {name for candidate in CANDIDATES for name in candidate.networks}


class Timed:
    """A tracker that takes no time, but whose clock says what is asked for."""

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        return MaskEstimate(None)

    def step(self, frame: Frame) -> MaskEstimate:
        self.clock[0] += self.seconds
        return MaskEstimate(None)


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """A cache with some networks, on a machine where a frame of a network takes so long."""

    def given(*networks: str, seconds: float = 0.5, broken: bool = False) -> None:
        clock = [0.0]
        tracker = type("Given", (Timed,), {"clock": clock, "seconds": seconds})
        states = dict.fromkeys(networks, tracker_selection.State.OK)

        def build(group, choice):
            if broken:
                raise PluginError("It is broken.")
            return tracker()

        monkeypatch.setattr(
            tracker_selection,
            "state_of",
            lambda network: states.get(network.name, tracker_selection.State.ABSENT),
        )
        monkeypatch.setattr(tracker_selection, "build_plugin", build)
        monkeypatch.setattr(tracker_selection.time, "perf_counter", lambda: clock[0])

    monkeypatch.setenv(VARIABLE, str(tmp_path))
    return given


def chosen(frames: int | None = 100, live: bool = False) -> tuple[str, dict, str]:
    config, why = choose_tracker(AUTO, frames, live, FIRST, PROMPT)
    return config.tracker.name, config.tracker.options, why


def test_without_networks_it_is_the_best_that_needs_none(machine):
    machine()
    name, options, why = chosen()
    assert (name, options) == ("segment", {})
    assert "no network of a better one is in your cache" in why


def test_where_opencv_lacks_what_the_better_ones_need_it_is_flow(machine, monkeypatch):
    machine()
    monkeypatch.setattr(SegmentTracker, "why_unavailable", classmethod(lambda cls: "it is another wheel"))
    assert chosen()[0] == "csrt"
    monkeypatch.setattr(CsrtTracker, "why_unavailable", classmethod(lambda cls: "it is another wheel"))
    assert chosen()[0] == "flow"


def test_the_best_whose_networks_are_all_there_is_taken(machine):
    machine(*NETWORKS)
    assert chosen()[1]["segmenter"] == "mobile-sam"
    machine("u2netp", "nanotrack-backbone", "nanotrack-head", "mobile-sam-encoder")
    name, options, why = chosen()
    assert (name, options["segmenter"], options["box"]) == ("onnx", "u2netp", "nano")
    assert "0.50 s a frame here" in why


def test_what_a_long_video_cannot_afford_is_left(machine):
    machine(*NETWORKS, seconds=2.0)
    _, options, why = chosen(frames=1500)
    assert options["every"] == 5
    assert "which rules out MobileSAM in NanoTrack's box" in why
    assert chosen(frames=30_000)[0] == "segment"
    assert chosen(frames=None)[1]["every"] == 5
    assert chosen(live=True)[0] == "segment"


def test_networks_that_do_not_run_are_no_candidates(machine):
    machine(*NETWORKS, broken=True)
    assert chosen()[0] == "segment"


def test_damaged_networks_are_not_there(machine, tmp_path):
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "u2netp.onnx").write_bytes(b"not it")
    assert chosen()[0] == "segment"


def test_candidates_are_trackers_with_options_of_theirs_the_best_first():
    assert [one.iou for one in CANDIDATES] == sorted((one.iou for one in CANDIDATES), reverse=True)
    for candidate in CANDIDATES:
        check_tracker_options(load_config(tracker={"name": candidate.name, **candidate.options}))


def test_another_tracker_is_left_as_it_is():
    config = load_config(tracker="csrt")
    assert choose_tracker(config, 10, False, FIRST, PROMPT) == (config, "")


def test_auto_has_no_options_and_is_nothing_for_a_session():
    with pytest.raises(InputError, match=r"tracker\.every is an option of one tracker"):
        check_tracker_options(load_config(tracker={"name": "auto", "every": 5}))
    with pytest.raises(InputError, match="chosen from the first frame"):
        Session(AUTO, PROMPT)


def test_a_run_says_which_it_was_and_goes_on_with_it(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    images = [FIRST.image] * 3
    record(open_source(images), AUTO, tmp_path / "run", box=PROMPT.box)
    run = RunReader(tmp_path / "run")
    assert run.config["tracker"]["name"] == "segment"
    assert run.description["tracker_choice"].startswith("segment (")

    def refuse(*given):
        raise AssertionError("it is known already")

    monkeypatch.setattr("tracking3d.pipeline.open_tracking.choose_tracker", refuse)
    record(open_source(images), AUTO, tmp_path / "run", box=PROMPT.box, resume=True)
    assert json.loads((tmp_path / "run/run.json").read_text())["config"]["tracker"]["name"] == "segment"


def test_the_library_tracks_with_it(monkeypatch, tmp_path):
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    assert len(list(tracking3d.track([FIRST.image] * 2, box=PROMPT.box, config=AUTO))) == 2


def test_nothing_is_fetched():
    text = Path(tracker_selection.__file__).read_text(encoding="utf-8")
    assert "download" not in text
