"""Folders of photos in wide steps become one model, and what cannot be joined is told."""

from __future__ import annotations

import json
from collections import Counter
from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from resumable_runs import Stopped, assert_alike, settings, stop_at

from tracking3d.estimation.estimate import FREE_ROTATION, Status
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.solver import PhotoEstimates
from tracking3d.frames import MaskEstimate, mask_iou_or_none
from tracking3d.pipeline import lost_frames
from tracking3d.pipeline.record import record
from tracking3d.results import layout
from tracking3d.results.files import write_image, write_mask
from tracking3d.results.notes import notes_of_run
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.results.refinement_writer import clear_refinement
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.segment.network import ObjectNetwork
from tracking3d.video import open_source
from tracking3d.video.source import FrameSource
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors


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


@pytest.mark.slow
def test_a_turntable_in_steps_of_twenty_degrees_is_tracked(photos, tmp_path):
    folder, config = photos
    run = record(open_source(str(folder)), config, tmp_path / "run")
    found = np.stack([frame.T_cam_obj[:3, :3] for frame in run.frames])
    assert aligned_rotation_errors(found, turntable().T_cam_obj[:, :3, :3]).max() < 3
    assert "joined as photos" in start_of(run)["reason"]
    assert "advice" not in start_of(run)
    assert sum(frame.status is Status.TRACKED for frame in run.frames) >= 6


@pytest.mark.slow
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


def needs(statuses: list[Status], fps: float | None, lacks_points: bool) -> bool:
    """Whether photos are joined after causal estimates of these statuses."""
    causal = {index: SimpleNamespace(status=status) for index, status in enumerate(statuses)}
    masks = SimpleNamespace(estimates=SimpleNamespace(causal=causal), has_mask=lambda index: True)
    session = SimpleNamespace(lacks_points=lambda ended: lacks_points)
    return lost_frames.needs_photo_start(session, SimpleNamespace(fps=fps), masks)


VIDEO = cast(FrameSource, SimpleNamespace(fps=30.0))  # its masks stay as they are
GOOD, BAD = [Status.TRACKED] * 8, [Status.UNCERTAIN] * 5 + [Status.TRACKED] * 3


@pytest.mark.parametrize(
    ("statuses", "fps", "lacks_points", "needed"),
    [
        (GOOD, None, False, False),
        (GOOD, 30.0, False, False),
        (BAD, None, False, True),  # images without times, few of which are tracked
        (BAD, 30.0, False, False),  # a video has its other starts
        (BAD, 30.0, True, True),
        (GOOD, None, True, True),
        (BAD[:3], None, True, False),  # three photos are no set
    ],
)
def test_photos_are_joined_if_there_is_no_map_with_points_or_few_of_them_are_tracked(
    statuses, fps, lacks_points, needed
):
    assert needs(statuses, fps, lacks_points) is needed


def test_a_start_that_explains_no_more_than_there_is_stays_out():
    causal = {index: SimpleNamespace(status=status) for index, status in enumerate(GOOD)}
    masks = SimpleNamespace(estimates=SimpleNamespace(causal=causal), has_mask=lambda index: True)
    attempt = SimpleNamespace(confidence=dict.fromkeys(range(8), 0.9), poses=dict.fromkeys(range(8)))
    session = SimpleNamespace(
        start_from_photos=lambda photos: (attempt, ""), adopt=lambda attempt: pytest.fail("no better")
    )
    tried = lost_frames.TriedFrames(8, Counter())
    assert lost_frames.start_from_photos(session, VIDEO, masks, tried) == (None, "")
    assert tried.left == 0


def test_photos_that_are_not_joined_leave_the_other_tries_their_frames():
    causal = {index: SimpleNamespace(status=status) for index, status in enumerate(BAD)}
    masks = SimpleNamespace(estimates=SimpleNamespace(causal=causal), has_mask=lambda index: True)
    session = SimpleNamespace(start_from_photos=lambda photos: (None, "take more"))
    tried = lost_frames.TriedFrames(8, Counter())
    assert lost_frames.start_from_photos(session, VIDEO, masks, tried) == (None, "take more")
    assert tried.left == 8


def photo_masks(folder, masks, given=()):
    """The masks of photos, each by itself, after a mask tracker has given ``masks``."""
    source = open_source(str(folder))
    estimates = SimpleNamespace(
        causal=dict.fromkeys(range(len(masks))),
        initial_mask=lambda index: masks[index],
        is_given=lambda index: index in given,
    )

    def of(frame):
        mask = masks[frame.index]
        return MaskEstimate(None if mask is None else mask.astype(np.float32))

    before = SimpleNamespace(estimates=estimates, of=of)
    return lost_frames.PhotoMasks(source, before), list(source)


def test_photos_are_segmented_in_one_box_where_the_camera_stands_still(photos, monkeypatch):
    folder, _ = photos
    masks = list(turntable().masks.copy())
    masks[3][:, 160:] = False  # the mask tracker has lost one side,
    masks[4] = None  # and then everything
    own, frames = photo_masks(folder, masks, given={5})
    assert own.box is not None
    for index in (3, 4):
        assert mask_iou_or_none(own.of(frames[index]).found, turntable().masks[index]) > 0.9
    assert np.array_equal(own.of(frames[5]).found, masks[5])  # the user knows better
    again = own.of(frames[3])
    monkeypatch.setattr(ObjectNetwork, "segment_box", lambda *_: pytest.fail("it is segmented once"))
    assert np.array_equal(own.of(frames[3]).found, again.found)
    assert np.array_equal(own.of(frames[3]).occluder, again.occluder)
    monkeypatch.undo()
    own, frames = photo_masks(folder, list(turntable().masks))  # nothing was lost, and masks stay as they are
    assert own.box is None and np.array_equal(own.of(frames[3]).found, turntable().masks[3])


def test_where_the_camera_or_the_object_moves_photos_keep_the_mask_trackers_masks(photos):
    folder, _ = photos
    masks = list(turntable().masks)
    far = [*masks[:-1], np.roll(masks[-1], 120, axis=1)]  # what strays makes the box of all too loose
    own, frames = photo_masks(folder, far)
    assert own.box is None and np.array_equal(own.of(frames[-1]).found, far[-1])
    room = np.random.default_rng(0).integers(0, 255, (240, 640, 3), np.uint8)
    for index, image in enumerate(turntable().images):
        wall = room[:, 40 * index : 40 * index + 320]
        write_image(folder / f"{index:03d}.png", np.where(masks[index][..., None], image, wall))
    own, frames = photo_masks(folder, masks)
    assert own.box is None and np.array_equal(own.of(frames[3]).found, masks[3])


def test_the_mask_trackers_masks_stay_beside_those_of_photos(tmp_path):
    (tmp_path / layout.INITIAL_MASKS).mkdir()
    (tmp_path / layout.REFINING).mkdir()
    tracked, own = np.zeros((2, 4, 6), bool)
    tracked[1:3, 1:3] = own[1:4, 1:5] = True
    write_mask(layout.initial_mask_path(tmp_path, 0), tracked)
    estimates = RefinedEstimates(tmp_path, (), (4, 6))
    estimates.put_initial_mask(0, MaskEstimate(own.astype(np.float32), occluder=~own))
    assert np.array_equal(estimates.initial_mask(0), own)
    assert np.array_equal(estimates.occluder(0), ~own)
    clear_refinement(tmp_path)
    assert np.array_equal(estimates.initial_mask(0), tracked)
    assert not (tmp_path / layout.REFINING).exists()


def test_advice_on_photos_is_a_note_and_nobody_is_asked_to_film_other_sides():
    advice = "8 photos, none joined; photo 3 shares too few points with photos 2 and 4"
    camera = {"assumed": False, "origin": ""}
    run = {"source_notes": [], "camera": camera, "refinement": {"start": {"advice": advice}}}
    unseen = SimpleNamespace()  # a model that would be asked for what was never seen
    assert notes_of_run(run, unseen, []) == [advice]
    photos = [
        cast(FrameRecord, SimpleNamespace(free_axis=None, status=status, time=None))
        for status in (Status.TRACKED, Status.UNCERTAIN)
    ]
    assert advice in notes_of_run(run, None, photos)
    assert advice not in notes_of_run(run, None, photos[:1])  # found by the model of the others
    bottle = cast(FrameRecord, SimpleNamespace(free_axis=(0.0, 1.0, 0.0), status=Status.UNCERTAIN))
    assert advice not in notes_of_run(run, None, [bottle]) and FREE_ROTATION in notes_of_run(
        run, None, [bottle]
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
