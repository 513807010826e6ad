"""The tracker ``auto``: the best that is there and that the video can afford, and a sentence that says why."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from refining_solver import StandInSolver

import tracking3d
from tracking3d import PipelineConfig, load_config
from tracking3d.errors import PluginError
from tracking3d.features.networks.store import VARIABLE
from tracking3d.frames import Frame, Prompt
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
AUTO = load_config()
VGA, LARGE = (480, 640), (2160, 3840)
NETWORKS = {name for candidate in CANDIDATES for name in candidate.networks}
RECOMMENDED = {"u2netp", "nanotrack3-backbone", "nanotrack3-head"}


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """A cache with some networks."""

    def given(*networks: str) -> None:
        states = dict.fromkeys(networks, tracker_selection.State.OK)
        absent = tracker_selection.State.ABSENT
        monkeypatch.setattr(tracker_selection, "state_of", lambda one: states.get(one.name, absent))

    monkeypatch.setenv(VARIABLE, str(tmp_path))
    return given


def chosen(
    frames: int | None = 100, live: bool = False, size: tuple[int, int] = VGA
) -> tuple[str, dict, str]:
    config, why = choose_tracker(AUTO, frames, live, size)
    return config.tracker.name, config.tracker.options, why


def test_it_is_the_default_everywhere():
    presets = ("default", "rerendering", "paper")
    assert [load_config(preset=name).tracker.name for name in presets] == ["auto", "csrt", "csrt"]
    assert PipelineConfig().tracker.name == load_config(quality="good").tracker.name == "auto"


def test_without_networks_it_is_the_best_that_needs_none(cache):
    cache()
    name, options, why = chosen()
    assert (name, options) == ("segment", {})
    assert "no network of a better one is in your cache" in why


def test_where_opencv_lacks_what_the_better_ones_need_it_is_flow(cache, monkeypatch):
    cache()
    monkeypatch.setattr(SegmentTracker, "why_unavailable", classmethod(lambda cls: "it is another wheel"))
    assert chosen()[0] == "csrt"
    monkeypatch.setattr(CsrtTracker, "why_unavailable", classmethod(lambda cls: "it is another wheel"))
    assert chosen()[0] == "flow"


def test_the_best_whose_networks_are_all_there_is_taken(cache):
    cache(*NETWORKS)
    assert chosen()[1]["segmenter"] == "mobile-sam"
    cache("u2netp", "nanotrack-backbone", "nanotrack-head", "mobile-sam-encoder")
    name, options, why = chosen()
    assert (name, options["segmenter"], options["box"]) == ("onnx", "u2netp", "nano")
    assert "about 0.97 s a frame" in why


def test_what_a_long_video_cannot_afford_is_left(cache):
    cache(*NETWORKS)
    _, options, why = chosen(frames=1500)
    assert options["every"] == 5
    assert "which rules out MobileSAM in NanoTrack's box" in why
    assert chosen(frames=30_000)[0] == "segment"
    assert chosen(live=True)[0] == "segment"


def test_a_larger_picture_costs_more(cache):
    cache(*RECOMMENDED)
    assert "every" not in chosen(frames=None)[1]
    assert chosen(frames=None, size=LARGE)[1]["every"] == 5
    costs = [CANDIDATES[0].cost(size) for size in (VGA, (1080, 1920), LARGE)]
    assert costs == sorted(set(costs))


def test_damaged_networks_are_not_there(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "u2netp.onnx").write_bytes(b"not it")
    assert chosen()[0] == "segment"


def test_candidates_are_trackers_with_options_of_theirs_the_best_first():
    assert [one.iou for one in CANDIDATES] == sorted((one.iou for one in CANDIDATES), reverse=True)
    for candidate in CANDIDATES:
        check_tracker_options(load_config(tracker={"name": candidate.name, **candidate.options}))


def test_another_tracker_is_left_as_it_is():
    config = load_config(tracker="csrt")
    assert choose_tracker(config, 10, False, VGA) == (config, None)


def test_options_without_the_name_of_a_tracker_are_those_of_segment(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("tracker: {network: 2}")
    named = {"name": "segment", "network": 2}
    for config in (
        load_config(overrides=["tracker.network=2"]),
        load_config(overrides=["tracker.network=2"], tracker="auto"),
        load_config(tracker={"network": 2}),
        load_config(file),
        load_config(file, tracker="segment"),
        PipelineConfig(tracker={"name": "auto", "network": 2}),
    ):
        assert config.tracker.model_dump() == named
    with pytest.raises(PluginError, match=r"mask tracker 'segment' .* there is no option 'every'"):
        check_tracker_options(load_config(overrides=["tracker.every=5"]))


def test_a_session_decides_on_it_by_its_first_frame(monkeypatch, tmp_path, cache):
    cache()
    monkeypatch.setitem(SOLVERS, "online", StandInSolver)
    session = Session(AUTO, PROMPT)
    assert session.config.tracker.name == "auto"
    session.step(FIRST)
    assert session.config.tracker.name == "segment"
    other = Session(AUTO, PROMPT)
    other.load_state_dict(FIRST, session.state_dict(), {})
    assert other.config == session.config


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
