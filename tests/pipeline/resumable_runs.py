"""Runs that are stopped and resumed, and what tells whether that left a trace."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tracking3d import load_config
from tracking3d.results import layout
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader, read_records

POSE = 1e-5
"""By which poses may differ from those of a run that was not stopped."""


class Stopped(KeyboardInterrupt):
    """Ctrl-C at a chosen moment."""


def settings(*overrides: str):
    """Of runs that take no time, by masks of a tracker unless others are given."""
    precomputed = any("precomputed" in override for override in overrides)
    quick = [] if precomputed else ["tracker.name=flow", "tracker.segmentation_size=64"]
    return load_config(
        overrides=[
            *quick,
            "crop.size=32",
            "object.frequency=2",
            "object.texture_size=32",
            "camera.fov=45",
            *overrides,
        ],
        runtime={"on_plugin_failure": "stop"},
    )


def stop_at(monkeypatch, owner, name: str, call: int, error: BaseException | None = None) -> None:
    """Raise at the ``call``-th call, counted from 0."""
    method, calls = getattr(owner, name), []

    def stopping(self, *given, **named):
        calls.append(name)
        if len(calls) == call + 1:
            raise error or Stopped()
        return method(self, *given, **named)

    monkeypatch.setattr(owner, name, stopping)


def assert_alike(resumed: Path, whole: Path) -> None:
    """Both runs are finished with the same answers, and nothing but answers is left."""
    for refined in (True, False):
        one, other = RunReader(resumed, refined), RunReader(whole, refined)
        assert one.state == other.state == "finished", one.description["error"]
        assert [frame.index for frame in one.frames] == [frame.index for frame in other.frames]
        for mine, expected in zip(one.frames, other.frames, strict=True):
            about = f"frame {mine.index}, refined {refined}"
            np.testing.assert_allclose(mine.T_cam_obj, expected.T_cam_obj, atol=POSE, err_msg=about)
            assert (mine.status, mine.reason, mine.keyframe, mine.name, mine.refined, mine.failure) == (
                expected.status,
                expected.reason,
                expected.keyframe,
                expected.name,
                expected.refined,
                expected.failure,
            ), about
            np.testing.assert_array_equal(one.mask(mine.index), other.mask(mine.index), err_msg=about)
            assert (one.initial_mask(mine.index) is None) == (other.initial_mask(mine.index) is None)
        mine, expected = load_model(one.mesh_folder), load_model(other.mesh_folder)
        np.testing.assert_allclose(mine.vertices, expected.vertices, atol=POSE)
        difference = np.abs(mine.texture.astype(int) - expected.texture)
        assert np.mean(difference) < 0.01
    for name in ("counts", "skipped", "failures", "camera", "iou_initial_mean"):
        assert one.description[name] == other.description[name], name
    # None torn and none twice: as many whole lines, in the same order.
    lines = [
        [(line.index, line.revision, line.refined) for line in read_records(run / layout.FRAMES)]
        for run in (resumed, whole)
    ]
    assert lines[0] == lines[1]
    assert sorted(without_state(resumed) ^ without_state(whole)) == []
    assert not any(layout.has_state(run) for run in (resumed, whole))


def files_of(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def without_state(folder: Path) -> set[Path]:
    """The files but those of earlier states, which may have other numbers."""
    return {path for path in files_of(folder) if path.parts[0] != layout.STATE}


def finished_frames(folder: Path) -> int:
    """How many frames are answered in a run that was killed; each has its mask whole."""
    if not (folder / layout.RUN).is_file():
        return 0
    run = RunReader(folder)
    assert json.loads((folder / layout.RUN).read_bytes())["state"] in ("running", "finished")
    for frame in run.frames:
        assert run.mask(frame.index).shape == (run.camera.height, run.camera.width)
    return len(run.frames)
