"""A correction refines only what it changes: the other frames keep their refined poses, masks and surface."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from refining_solver import CausalSolver, StandInSolver
from scipy.spatial.transform import Rotation

from tracking3d import load_config
from tracking3d.estimation.solver import RefinedStart
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.correct import correct_run
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results import layout
from tracking3d.results.checkpoint import folder
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import StageProgress, listen_to_progress
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.video import open_source

FRAMES, CORRECTED = 8, 6
KEPT = list(range(CORRECTED))


class ContinuingSolver(StandInSolver):
    """Can start from an earlier refinement, too; a revisited pose is the one that is predicted."""

    kept: list[int] = []  # noqa: RUF012 (cleared by the fixture)

    def continue_refinement(self, state: int, start: RefinedStart) -> int | None:
        return -1

    def keep_frame(self, state: int, frame: Frame, T_cam_obj) -> int:
        self.kept.append(frame.index)
        return state

    def keyframe_poses(self, state: int) -> dict[int, np.ndarray]:
        return {}


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES, size=(80, 64), supersample=1, degrees_per_frame=4))


@pytest.fixture
def images(clip, tmp_path) -> Path:
    (tmp_path / "clip").mkdir()
    for index, image in enumerate(clip.images):
        write_image(tmp_path / "clip" / f"{index:03d}.png", image)
    return tmp_path / "clip"


@pytest.fixture(autouse=True)
def every_frame(monkeypatch):
    monkeypatch.setattr(folder, "_FIRST_GAP", 1)
    monkeypatch.setitem(SOLVERS, "online", ContinuingSolver)
    monkeypatch.setattr(CausalSolver, "faults", {})
    ContinuingSolver.kept.clear()


@pytest.fixture
def refined(monkeypatch) -> list[int]:
    """Frames that a session refines."""
    frames, refine_frame = [], Session.refine_frame

    def noting(self, frame, *more):
        frames.append(frame.index)
        return refine_frame(self, frame, *more)

    monkeypatch.setattr(Session, "refine_frame", noting)
    return frames


def settings(*overrides: str):
    quick = [
        "tracker.name=flow",
        "tracker.segmentation_size=64",
        "crop.size=32",
        "object.frequency=2",
        "camera.fov=45",
    ]
    return load_config(
        overrides=[
            *quick,
            "object.texture_size=32",
            "object.refine_masks=false",
            "object.adjustment_views=0",
            *overrides,
        ]
    )


def run(clip, images, folder: Path, *overrides: str, **given) -> Path:
    record(open_source(str(images)), settings(*overrides), folder, mask=clip.masks[0], **given)
    return folder


def moved(clip, frame: int = CORRECTED) -> list[Correction]:
    """The object's mask, moved by some pixels."""
    return [Correction(frame, mask=np.roll(clip.masks[frame], 3, axis=1))]


def test_only_the_frames_that_a_correction_changes_are_refined(clip, images, tmp_path, refined):
    folder = run(clip, images, tmp_path / "run")
    before = RunReader(folder)
    poses, masks = (
        {one.index: make(one) for one in before.frames}
        for make in (_pose, lambda one: before.mask(one.index))
    )
    refined.clear()
    correct_run(folder, moved(clip))
    assert refined == [6, 7]
    assert ContinuingSolver.kept == [5]  # the frame that leads into them
    after = RunReader(folder)
    assert [one.index for one in after.frames if one.refined] == list(range(FRAMES))
    for index in KEPT:
        np.testing.assert_array_equal(after.frames[index].T_cam_obj, poses[index])
        np.testing.assert_array_equal(after.mask(index), masks[index])
    assert (after.mask(CORRECTED) != masks[CORRECTED]).any()
    refinement = after.description["refinement"]
    assert (refinement["state"], refinement["frames"], refinement["kept_refined"]) == (
        "finished",
        FRAMES,
        len(KEPT),
    )


def test_the_listener_hears_of_every_frame_in_both_passes(clip, images, tmp_path):
    folder = run(clip, images, tmp_path / "run")
    heard = []
    correct_run(folder, moved(clip), listener=lambda frame: heard.append((frame.index, frame.refined)))
    assert heard == [(index, again) for again in (False, True) for index in range(FRAMES)]


def test_frames_that_keep_their_estimates_are_no_steps_of_the_stages(clip, images, tmp_path):
    folder = run(clip, images, tmp_path / "run")
    heard: list[StageProgress] = []
    with listen_to_progress(heard.append):
        correct_run(folder, moved(clip))
    for stage, total in (("tracking", FRAMES), ("refining frames", 2), ("drawing", 2)):
        steps = [(one.done, one.total) for one in heard if one.name == stage]
        assert steps == [(done, total) for done in range(total + 1)], stage


def test_a_second_correction_starts_from_what_the_first_one_left(clip, images, tmp_path, refined):
    folder = run(clip, images, tmp_path / "run")
    correct_run(folder, moved(clip))
    first = {one.index: one.T_cam_obj for one in RunReader(folder).frames}
    refined.clear()
    correct_run(folder, moved(clip, 7))
    assert refined == [7]
    for one in RunReader(folder).frames[:7]:
        np.testing.assert_array_equal(one.T_cam_obj, first[one.index])


def test_a_correction_that_is_stopped_while_it_refines_goes_on(clip, images, tmp_path, monkeypatch, refined):
    folder = run(clip, images, tmp_path / "run")
    before = RunReader(folder).frames
    refined.clear()
    with monkeypatch.context() as patch:
        patch.setattr(StandInSolver, "revisit_faults", {7: KeyboardInterrupt()})
        with pytest.raises(KeyboardInterrupt):
            correct_run(folder, moved(clip))
    assert [one.T_cam_obj.tolist() for one in RunReader(folder).frames] == [
        one.T_cam_obj.tolist() for one in before
    ]
    refined.clear()
    correct_run(folder, moved(clip))
    assert refined == [6, 7]
    lines = [json.loads(line) for line in (folder / layout.FRAMES).read_text().splitlines()]
    assert [one["index"] for one in lines if one["refined"]] == list(range(FRAMES))


@pytest.mark.parametrize("why", ["an early frame", "the solver cannot", "no refinement before"])
def test_otherwise_all_frames_are_refined_again(clip, images, tmp_path, monkeypatch, refined, why):
    folder = run(clip, images, tmp_path / "run")
    if why == "the solver cannot":
        monkeypatch.setattr(ContinuingSolver, "continue_refinement", lambda *given: None)
    if why == "no refinement before":
        lines = (folder / layout.FRAMES).read_text().splitlines(keepends=True)
        (folder / layout.FRAMES).write_text("".join(one for one in lines if not json.loads(one)["refined"]))
    refined.clear()
    correct_run(folder, moved(clip, 2 if why == "an early frame" else CORRECTED))
    assert refined == list(range(FRAMES))
    assert RunReader(folder).description["refinement"]["kept_refined"] == 0


def test_probabilities_of_kept_frames_stay(clip, images, tmp_path):
    folder = run(clip, images, tmp_path / "run", "runtime.probabilities=true")
    for index in range(FRAMES):  # as if they had been decided from
        write_image(layout.probability_path(folder, index), np.full((64, 80), index, np.uint8))
    correct_run(folder, moved(clip))
    for index in KEPT:
        np.testing.assert_allclose(RunReader(folder).probability(index), index / 255)


def test_a_causal_pose_is_predicted_as_its_neighbours_were_refined():
    """The refinement turned the object, doubled its size and changed the lens; the prediction does the same."""
    lens_before, camera = 500.0, Camera(600.0, 600.0, 320.0, 240.0, 640, 480, "given", False)
    generator = np.random.default_rng(3)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=4).as_matrix()
    poses = {}
    for index in range(6):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = (
            Rotation.random(random_state=index).as_matrix(),
            [*generator.normal(0, 0.3, 2), 8 + index],
        )
        poses[index] = T

    def as_refined(T):
        T = T.copy()
        T[:3, 3] *= 2
        T[2, 3] *= camera.fx / lens_before
        return T @ turn

    start = RefinedStart(
        camera,
        np.zeros((0, 3)),
        {index: as_refined(poses[index]) for index in range(5)},
        {index: poses[index] for index in range(5)},
        dict.fromkeys(range(5), lens_before),
    )
    assert start.scale == pytest.approx(2)
    np.testing.assert_allclose(start.predict(5, poses[5], lens_before), as_refined(poses[5]), atol=1e-9)
    np.testing.assert_array_equal(start.predict(2, poses[5], lens_before), start.refined[2])


def _pose(one):
    return one.T_cam_obj
