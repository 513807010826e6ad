"""An object that is known is found without a start by motion, in its own coordinates; what is not there is not."""

from __future__ import annotations

import numpy as np
import pytest
from known_things import box_of, config, degrees_between, filmed, mesh_of, written
from typer.testing import CliRunner

from tracking3d import Frame, Prompt, Session, Status, track, track_objects
from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import RELOCALIZED
from tracking3d.estimation.online import known_object
from tracking3d.estimation.online.known_object import NOT_SEEN
from tracking3d.pipeline.frame_reading import FrameOrder
from tracking3d.pipeline.known_object import read_known_object
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.pipeline.session_refinement import Attempt
from tracking3d_bench.evaluation.metrics import mask_iou


@pytest.fixture
def few_sides(monkeypatch):
    """Enough for a box, and drawn in a moment."""
    monkeypatch.setattr(known_object, "SIDES", 14)


@pytest.fixture(scope="module")
def clip():
    return filmed()


def test_it_is_found_in_the_first_frame_without_a_box_in_the_mesh_s_own_coordinates(
    clip, tmp_path, few_sides
):
    mesh = mesh_of(clip.scene.solid)
    mesh.apply_scale(1000.0)
    mesh.apply_translation((5.0, -700.0, 90.0))
    mesh.export(tmp_path / "thing.glb")
    found = list(track(list(clip.images), object=tmp_path / "thing.glb", config=config()))
    assert [one.status for one in found] == [Status.TRACKED] * len(clip.images)
    assert found[0].hypothesis == RELOCALIZED and found[0].initial_mask is None
    assert found[1].initial_mask is not None  # the mask tracker was set on what was found
    for one, truth, mask in zip(found, clip.scene.T_cam_obj, clip.masks, strict=True):
        assert degrees_between(one.T_cam_obj, truth) < 2
        middle = one.T_cam_obj[:3, :3] @ [5.0, -700.0, 90.0] + one.T_cam_obj[:3, 3]
        assert np.linalg.norm(middle - 1000 * truth[:3, 3]) < 0.02 * 1000 * np.linalg.norm(truth[:3, 3])
        assert mask_iou(one.mask, mask) > 0.9


def test_without_colours_its_outline_tells_where_a_box_is_and_else_nothing_does(clip, tmp_path, few_sides):
    path = written(clip.scene.solid, tmp_path, textured=False)
    with pytest.raises(InputError, match=r"no colours.*box="):
        next(track(list(clip.images), object=path, config=config()))
    first = next(track(list(clip.images), object=path, mask=clip.masks[0], config=config()))
    assert first.hypothesis == "outline" and first.status is not Status.LOST
    half_turns = [
        degrees_between(first.T_cam_obj, clip.scene.T_cam_obj[0] @ turn) for turn in half_turns_of_a_box()
    ]
    assert min(half_turns) < 5


def test_poses_to_start_from_are_in_its_own_coordinates_as_estimates_are(clip, tmp_path, few_sides):
    mesh = mesh_of(clip.scene.solid)
    mesh.apply_scale(1000.0)
    mesh.apply_translation((5.0, -700.0, 90.0))
    mesh.export(tmp_path / "thing.glb")
    session = Session(config(object={"model": str(tmp_path / "thing.glb")}), None)
    T_cam_obj = session.step(Frame(0, clip.images[0])).T_cam_obj
    session.adopt(Attempt(session._state, FrameOrder(0), {0: T_cam_obj}, {0: 1.0}))
    start = session._state.extended[0]
    assert 1 < start[2, 3] < 20  # the solver's unit is a radius of about 1
    np.testing.assert_allclose(session._known.from_solver(start), T_cam_obj)


def half_turns_of_a_box():
    """That leave its shape as it is."""
    return [np.diag([*signs, 1.0]) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]


@pytest.mark.slow
def test_where_it_is_not_seen_frames_are_lost_and_say_so(clip, tmp_path, few_sides):
    path = written(clip.scene.solid, tmp_path)
    wall = np.random.default_rng(0).integers(0, 255, (2, 150, 200, 3), dtype=np.uint8)
    frames = [*wall, *clip.images[:1]]
    estimates = list(track(frames, object=path, config=config()))
    assert [one.status for one in estimates] == [Status.LOST, Status.LOST, Status.TRACKED]
    assert all(one.reason.startswith(NOT_SEEN) and not one.mask.any() for one in estimates[:2])
    assert degrees_between(estimates[2].T_cam_obj, clip.scene.T_cam_obj[0]) < 2


@pytest.mark.slow
def test_a_session_goes_on_where_another_was_stopped(clip, tmp_path, few_sides):
    settings = config(object={"model": str(written(clip.scene.solid, tmp_path))})
    frames = [Frame(n, image) for n, image in enumerate(clip.images)]
    whole, stopped = Session(settings, None), Session(settings, None)
    corrections = []
    for frame in frames[:2]:
        whole.step(frame)
        estimate = stopped.step(frame)
        corrections.append(estimate.mask if stopped.corrected else None)
    assert corrections[0] is not None  # where the tracker was told at last where the object is
    resumed = Session(settings, None)
    resumed.load_state_dict(frames[0], stopped.state_dict(), {})
    assert resumed.replays
    for frame, correction in zip(frames[:2], corrections, strict=True):
        resumed.replay(frame, frame.index == 0, correction)
    then, wanted = resumed.step(frames[2]), whole.step(frames[2])
    np.testing.assert_array_equal(then.T_cam_obj, wanted.T_cam_obj)
    np.testing.assert_array_equal(then.mask, wanted.mask)


@pytest.mark.slow
def test_an_object_of_an_earlier_run_is_found_under_another_light(tmp_path):
    from tracking3d.pipeline.record import record
    from tracking3d.results.run_reader import RunReader
    from tracking3d.video import open_source

    learnt = filmed(frames=24, size=(320, 240), seed=12, degrees_per_frame=5)
    shown = filmed(frames=4, size=(320, 240), seed=12, motion="turntable", lamp=(0.7, -0.3, -0.6))
    source = open_source(list(learnt.images))
    record(source, config(), tmp_path / "run", box=box_of(learnt.masks[0]))
    run = RunReader(tmp_path / "run")
    first = run.frames[0]
    # The run's axes in the true object's: they are those of every other video, too.
    turn = learnt.scene.T_cam_obj[first.index][:3, :3].T @ first.T_cam_obj[:3, :3]
    for one, truth in zip(
        track(list(shown.images), object=tmp_path / "run", config=config()),
        shown.scene.T_cam_obj,
        strict=True,
    ):
        assert one.status is Status.TRACKED
        assert degrees_between(one.T_cam_obj[:3, :3], truth[:3, :3] @ turn) < 3


def test_points_of_a_drawn_side_lie_where_its_pixels_show_them(clip, tmp_path, few_sides):
    known = read_known_object(written(clip.scene.solid, tmp_path))
    from tracking3d.estimation.online.mapping.local_mapping import project_points
    from tracking3d.geometry.camera import Camera
    from tracking3d.pipeline.components import build_encoder

    settings = config()
    learnt, space = known_object.map_of_known_object(
        known, settings, build_encoder(settings), known_object.torch.device("cpu")
    )
    camera = Camera.from_fov(320, 320, 30.0)
    assert learnt.fixed_keyframes == len(learnt.keyframes) == 14 and space is not None
    gaps = []
    for view in learnt.keyframes:
        place = project_points(learnt.landmarks[view.points.landmark], view.pose, camera)
        gaps.append(np.linalg.norm(place - view.points.pixel, axis=1))
    gaps = np.concatenate(gaps)
    assert len(gaps) > 300 and np.median(gaps) < 0.05


def test_sides_are_spread_all_around():
    axes = np.stack([R[2] for R in known_object.sides(42)])
    for R in known_object.sides(42):
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
    nearest = np.degrees(np.arccos(np.sort(axes @ axes.T, 1)[:, -2]))
    assert nearest.min() > 15 and nearest.max() < 35


def test_a_mask_tracker_that_nobody_has_told_anything_waits(clip):
    tracker = PromptedTracker(PluginChoice(name="csrt"), None)
    first, second = (Frame(n, clip.images[n]) for n in range(2))
    assert tracker.waits and tracker.start(first).mask is None and tracker.step(second).mask is None
    assert tracker.can_correct and not tracker.can_resume
    tracker.correct(second, clip.masks[1])
    assert not tracker.waits and tracker.step(Frame(2, clip.images[2])).found is not None
    told = PromptedTracker(PluginChoice(name="csrt"), None)
    told.start(first)
    assert (
        told.step(second, Prompt(box_of(clip.masks[1]), clip.masks[1])).found is not None and not told.waits
    )


def refused(*arguments: object) -> str:
    from tracking3d.cli import app

    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 2, result.output
    return result.stderr


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        (("--model", "fine"), "are fixed"),
        (("--model", "fast"), "are fixed"),
        (("--split", "40f"), "leave out --split, or --object"),
        (("--box", "1,2,30,40", "--box", "50,60,30,40"), "2 objects are given"),
        (("--flat",), "flat or not"),
        (("--preset", "paper"), "the solver paper"),
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, monkeypatch, more, sentence):
    from tracking3d.video import VideoWriter

    monkeypatch.chdir(tmp_path)
    with VideoWriter(tmp_path / "clip.mp4", 10, (48, 64)) as writer:
        for _ in range(2):
            writer.write(np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "known").mkdir()
    assert sentence in refused("run", "clip.mp4", "--object", "known", "--out", "run", *more)
    assert not (tmp_path / "run").exists()


def test_an_object_that_is_nowhere_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.mp4").touch()
    assert "nowhere does not exist" in refused("run", "clip.mp4", "--object", "nowhere", "--out", "run")


def test_the_library_says_what_it_cannot_take(clip):
    frames = list(clip.images)
    with pytest.raises(InputError, match=r"object= is the number 3|object= is"):
        track(frames, object=3)
    with pytest.raises(InputError, match="are fixed"):
        track(frames, object="nowhere", model="fine")
    known = config(object={"model": "nowhere"})
    with pytest.raises(InputError, match="2 objects are given"):
        list(track_objects(frames, boxes=[(0, 0, 9, 9), (9, 9, 9, 9)], config=known))
