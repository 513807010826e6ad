"""The final refinement estimates again only the frames that need it; the others keep their causal estimates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refining_solver import CausalSolver, StandInSolver

from tracking3d import Status, load_config
from tracking3d.pipeline.record import record
from tracking3d.pipeline.refinement_steps import RefinementSteps
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.ui.sentences import passes_in_words
from tracking3d.video import open_source

FRAMES, DOUBTFUL, MOVED = 8, 3, 6
CLOSER = 2.0
"""The refinement makes the object this many times larger, so that causal depths grow with it."""


class MappingSolver(StandInSolver):
    """Tracks all frames but one; its refined keyframes are those with an even index."""

    def _answer(self, frame, mask):
        causal = super()._answer(frame, mask)
        return causal if frame.index == DOUBTFUL else replace(causal, status=Status.TRACKED, reason="")

    def continue_refinement(self, state, start):
        return None

    def keep_frame(self, state, frame, T_cam_obj):
        return state

    def keyframe_poses(self, state):
        poses = {}
        for index in range(0, FRAMES, 2):
            poses[index] = np.eye(4)
            poses[index][:3, 3] = CLOSER * index, 0, CLOSER * 3
        return poses


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES, size=(80, 64)))


@pytest.fixture
def images(clip, tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    for index, image in enumerate(clip.images):
        write_image(tmp_path / "clip" / f"{index:03d}.png", image)
    return tmp_path / "clip"


@pytest.fixture
def again(monkeypatch) -> list[int]:
    """Frames that a session estimates again."""
    frames, refine_frame = [], Session.refine_frame

    def noting(self, frame, *more):
        frames.append(frame.index)
        return refine_frame(self, frame, *more)

    monkeypatch.setattr(Session, "refine_frame", noting)
    monkeypatch.setitem(SOLVERS, "online", MappingSolver)
    monkeypatch.setattr(CausalSolver, "faults", {})
    return frames


@pytest.fixture
def landmarks(monkeypatch) -> None:
    """The adjustment has landmarks, and contradicts one frame."""
    monkeypatch.setattr(
        RefinementSteps, "_needs_retracking", lambda self, record, frame, T: frame.index == MOVED
    )


def run(clip, images, folder: Path, agreement: float = 0.5, quality: str | None = None) -> RunReader:
    """The stand-in's masks are those of the mask tracker but for a pixel, and agree with them by .9 or so."""
    quick = ["tracker.name=flow", "tracker.segmentation_size=64", "object.refine_masks=false", "crop.size=64"]
    quick += ["object.adjustment_views=0", "object.shape=fast"]
    quick += [] if quality else [f"object.mask_agreement={agreement}"]
    config = load_config(overrides=quick, quality=quality)
    return record(open_source(str(images)), config, folder, mask=clip.masks[0])


@pytest.mark.usefixtures("landmarks")
def test_only_frames_that_are_doubtful_or_that_the_adjustment_contradicts_are_estimated_again(
    clip, images, tmp_path, again
):
    estimated = run(clip, images, tmp_path / "run")
    assert again == [DOUBTFUL, MOVED]
    assert estimated.description["refinement"]["passed_over"]["retracking"] == FRAMES - 2
    timings = estimated.description["timings"]
    passes = ["tracking", "lost frames", "map", "retracking", "landmarks", "poses", "model"]
    assert list(timings["passes"]) == passes
    assert sum(timings["passes"].values()) == pytest.approx(timings["seconds_total"])
    assert f"({FRAMES - 2} frames passed over)" in passes_in_words(estimated.description)
    for one, causal in zip(estimated.frames, RunReader(tmp_path / "run", refined=False).frames, strict=True):
        assert one.refined and one.keyframe == causal.keyframe
        kept = one.index not in again
        assert (estimated.mask(one.index) == estimated.initial_mask(one.index)).all() != kept


@pytest.mark.usefixtures("landmarks")
def test_a_frame_that_keeps_its_estimate_has_its_pose_in_the_final_object_frame(
    clip, images, tmp_path, again
):
    estimated = run(clip, images, tmp_path / "run")
    for one in estimated.frames:
        depth = CLOSER * 3 + (one.index in again)  # the stand-in answers one further away
        np.testing.assert_allclose(one.T_cam_obj[:3, 3], [CLOSER * one.index, 0, depth])
        assert one.camera is None  # that of the run


def test_without_landmarks_every_frame_is_estimated_again(clip, images, tmp_path, again):
    estimated = run(clip, images, tmp_path / "run")
    assert sorted(again) == list(range(FRAMES))
    assert estimated.description["refinement"]["passed_over"]["retracking"] == 0


@pytest.mark.usefixtures("landmarks")
def test_a_frame_whose_mask_the_mask_tracker_contradicts_is_estimated_again(clip, images, tmp_path, again):
    run(clip, images, tmp_path / "run", agreement=0.99)
    assert again == list(range(FRAMES))


@pytest.mark.usefixtures("landmarks")
def test_the_best_quality_estimates_every_frame_again(clip, images, tmp_path, again):
    run(clip, images, tmp_path / "run", quality="best")
    assert again == list(range(FRAMES))
