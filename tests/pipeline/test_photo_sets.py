"""Folders of photos in wide steps become one model, and what cannot be joined is told."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from resumable_runs import Stopped, assert_alike, settings, stop_at

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.gap import PhotoEstimates
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.evaluation.metrics import aligned_rotation_errors
from tracking3d.pipeline import lost_frames
from tracking3d.pipeline.record import record
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source


@cache
def turntable() -> SyntheticClip:
    return synthesize(
        SyntheticSpec(
            shape="ellipsoid", frames=8, size=(320, 240), degrees_per_frame=20.0, axis=(0.0, -1.0, 0.25),
            drift=(0.0, 0.0, 0.0), fill=0.85, supersample=1,
        )
    )  # fmt: skip


@pytest.fixture
def photos(tmp_path):
    """A folder of photos, and the configuration with their masks."""
    folder = tmp_path / "photos"
    folder.mkdir()
    for index, image in enumerate(turntable().images):
        write_image(folder / f"{index:03d}.png", image)
    np.save(tmp_path / "masks.npy", turntable().masks)
    return folder, settings(
        "tracker.name=precomputed",
        f"tracker.path={tmp_path / 'masks.npy'}",
        "crop.size=64",
        "object.frequency=4",
    )


def start_of(run: RunReader) -> dict:
    return json.loads((run.folder / "run.json").read_text())["refinement"]["start"]


def test_a_turntable_in_steps_of_twenty_degrees_is_tracked(photos, tmp_path):
    folder, config = photos
    run = record(open_source(str(folder)), config, tmp_path / "run")
    found = np.stack([frame.T_cam_obj[:3, :3] for frame in run.frames])
    assert aligned_rotation_errors(found, turntable().T_cam_obj[:, :3, :3]).max() < 3
    assert "joined as photos" in start_of(run)["reason"]
    assert start_of(run)["advice"] == ""
    assert sum(frame.status is Status.TRACKED for frame in run.frames) >= 6


def test_photos_that_cannot_be_joined_are_named_and_nobody_asks_to_film(photos, tmp_path, monkeypatch):
    folder, config = photos
    advice = "8 photos, none joined; photo 3 shares too few points with photos 2 and 4"
    monkeypatch.setattr(
        OnlineSolver, "start_from_photos", lambda self, state, photos: (state, PhotoEstimates((), advice))
    )
    run = record(open_source(str(folder)), config, tmp_path / "run")
    notes = json.loads((run.folder / "run.json").read_text())["notes"]
    assert advice in notes
    assert not any("film" in note for note in notes)
    assert start_of(run)["advice"] == advice


def test_a_video_with_a_good_map_is_never_taken_for_photos(photos, tmp_path, monkeypatch):
    clip = synthesize(
        SyntheticSpec(frames=16, size=(160, 120), degrees_per_frame=5.0, drift=(0.2, -0.1, 0.2))
    )
    folder = tmp_path / "video"
    folder.mkdir()
    for index, image in enumerate(clip.images):
        write_image(folder / f"{index:03d}.png", image)
    monkeypatch.setattr(lost_frames, "start_from_photos", lambda *given: pytest.fail("there is a map"))
    record(
        open_source(str(folder)),
        settings("crop.size=64", "object.frequency=5"),
        tmp_path / "run",
        mask=clip.masks[0],
    )


@pytest.mark.slow
def test_a_run_killed_while_photos_are_joined_is_resumed_with_the_same_answers(photos, tmp_path, monkeypatch):
    folder, config = photos
    record(open_source(str(folder)), config, tmp_path / "whole")
    with monkeypatch.context() as patch:
        stop_at(patch, OnlineSolver, "start_from_photos", 0)
        with pytest.raises(Stopped):
            record(open_source(str(folder)), config, tmp_path / "run")
    record(open_source(str(folder)), config, tmp_path / "run", resume=True)
    assert_alike(tmp_path / "run", tmp_path / "whole")
