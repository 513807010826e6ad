"""Recordings of live sources, whose first map may come after the last frame; and of sources that only look like one."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from online_runs import FRAMES, solver, true_mask, turning_clip

from tracking3d.config.models import OnlineConfig, PipelineConfig
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online import initializer
from tracking3d.estimation.online.initialization.initial_map import InitialMap
from tracking3d.estimation.online.initialization.pending_frames import try_initialize
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.pipeline.record import record
from tracking3d.pipeline.track import track
from tracking3d.results.run_reader import RunReader
from tracking3d.video.array_source import ArraySource
from tracking3d.video.latest_frames import LatestFrames
from tracking3d.video.opening import LiveCamera, LiveStream
from tracking3d.video.source import EVERY_FRAME, is_live

PATIENCE = 120.0
"""Seconds until a test fails because a thread hangs."""


@dataclass(frozen=True)
class PlayedImages(ArraySource):
    """A live source that drops nothing; at its end the map may be handed out, and an error may come."""

    released: threading.Event | None = None
    ends_with: BaseException | None = None
    live: bool = True

    @property
    def repeatable(self) -> bool:
        return False

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        yield from super().__iter__()
        assert self.released is not None
        self.released.set()
        if self.ends_with is not None:
            raise self.ends_with


@pytest.fixture
def released(monkeypatch) -> Iterator[threading.Event]:
    """A map that is found is not handed out before this is set."""
    event = threading.Event()

    def hold(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        state, start = try_initialize(state, config, ended)
        if start is not None:
            assert event.wait(PATIENCE)
        return state, start

    monkeypatch.setattr(initializer, "try_initialize", hold)
    yield event
    event.set()


def config() -> PipelineConfig:
    """That of the small solver, without what a camera cannot have."""
    small = solver().config
    return small.model_copy(update={"solver": small.solver.model_copy(update={"final_refine": False})})


def images() -> list[Image]:
    return list(turning_clip().images)


@pytest.mark.parametrize("error", [None, KeyboardInterrupt(), ValueError("the camera was unplugged")])
def test_a_map_that_comes_after_the_last_frame_gives_all_pending_frames_their_poses(
    tmp_path: Path, released: threading.Event, error: BaseException | None
):
    source = PlayedImages(images(), released=released, ends_with=error)
    folder = tmp_path / "run"
    if error is None:
        record(source, config(), folder, mask=true_mask(0))
    else:
        with pytest.raises(type(error)):
            record(source, config(), folder, mask=true_mask(0))
    frames = RunReader(folder).frames
    assert [one.index for one in frames] == list(range(FRAMES))
    tracked = [one for one in frames if one.status is Status.TRACKED]
    assert frames[0] in tracked and len(tracked) >= 5
    assert (folder / "mesh.obj").is_file()


def test_an_iterator_waits_and_gives_the_same_estimates_as_a_list():
    given = {"mask": true_mask(0), "config": config()}
    from_list, from_iterator = list(track(images(), **given)), list(track(iter(images()), **given))
    assert any(estimate.revised for estimate in from_list)
    for a, b in zip(from_list, from_iterator, strict=True):
        np.testing.assert_array_equal(a.T_cam_obj, b.T_cam_obj)
        assert (a.status, len(a.revised)) == (b.status, len(b.revised))


def test_cameras_streams_and_latest_frames_are_live_and_nothing_else():
    camera = LiveCamera(0, EVERY_FRAME, None)
    stream = LiveStream("a stream", "http://127.0.0.1/stream", EVERY_FRAME, None)
    assert is_live(camera) and is_live(stream) and is_live(LatestFrames(ArraySource(images())))
    assert not is_live(ArraySource(images())) and not is_live(ArraySource(iter(images())))
