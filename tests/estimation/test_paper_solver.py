"""The solver as a state machine: what it answers, and what it keeps between frames."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch
import trimesh
from short_runs import estimate_of, frame, known_run, quick_solver, revised, run, short_clip, true_mask

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import Assessment, FrameEstimate, MaskSource, ObjectModel, Status
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.paper.problem import Losses
from tracking3d.estimation.paper.solver import PaperSolver
from tracking3d.features.rgb import RgbEncoder
from tracking3d.rendering import render
from tracking3d_bench.evaluation.metrics import mask_iou

PRESETS = pytest.mark.parametrize("preset", ["paper", "rerendering"])
FAILS = {"tau": 1e-6}


@PRESETS
def test_every_frame_is_answered(preset):
    estimates, _ = known_run(preset, 10)
    assert [estimate.index for estimate in estimates] == list(range(10))
    for estimate in estimates:
        T_cam_obj = estimate.T_cam_obj
        assert T_cam_obj.shape == (4, 4)
        assert T_cam_obj.dtype == np.float64
        np.testing.assert_allclose(T_cam_obj[:3, :3] @ T_cam_obj[:3, :3].T, np.eye(3), atol=1e-5)
        assert np.linalg.det(T_cam_obj[:3, :3]) == pytest.approx(1, abs=1e-5)
        assert T_cam_obj[3].tolist() == [0, 0, 0, 1]
        assert T_cam_obj[2, 3] > 0
        assert estimate.mask.shape == (80, 100)
        assert estimate.mask.dtype == bool
        np.testing.assert_array_equal(estimate.initial_mask, true_mask(estimate.index))
        assert set(estimate.losses) == {field.name for field in fields(Losses)} - {"features"} | {
            "appearance"
        }
        assert all(math.isfinite(value) for value in estimate.losses.values())
        assert 0 <= estimate.confidence <= 1
        assert estimate.iterations >= 1
        assert estimate.mask_source is MaskSource.RENDERED
        assert (estimate.reason == "") == (estimate.status is Status.TRACKED)
    assert sum(estimate.keyframe for estimate in estimates) >= 1


@PRESETS
def test_times_of_frames_are_passed_on(preset):
    solver = quick_solver(preset)
    state, first = solver.init(replace(frame(0), time=0.5), estimate_of(true_mask(0)))
    _, second = solver.step(state, frame(1), estimate_of(true_mask(1)))
    assert (first.time, second.time) == (0.5, None)


def test_the_paper_recipe_as_it_is_published():
    published = PaperSolver(load_config(preset="paper"), short_clip().camera, RgbEncoder())
    estimates, state = run(published, range(2))
    assert [estimate.status for estimate in estimates] == [Status.TRACKED, Status.TRACKED]
    first, second = estimates
    # On some processors the second frame is below tau from the first frame's pose on.
    assert 1 < first.iterations < 500 and 0 < second.iterations < 500
    assert len(state.vertices) == 1212
    assert state.texture.shape == (3, 300, 300)
    assert all(mask_iou(estimate.mask, true_mask(estimate.index)) > 0.8 for estimate in estimates)


@PRESETS
def test_the_same_input_gives_the_same_answers(preset):
    (once, model), (again, other) = (
        (revised(estimates), solver.result(state))
        for solver in [quick_solver(preset)]
        for estimates, state in (known_run(preset), run(solver))
    )
    for a, b in zip(once, again, strict=True):
        assert np.array_equal(a.T_cam_obj, b.T_cam_obj)
        assert np.array_equal(a.mask, b.mask)
        assert replace(a, T_cam_obj=0, mask=0, initial_mask=0, seconds=0, revised=()).__dict__ == (
            replace(b, T_cam_obj=0, mask=0, initial_mask=0, seconds=0, revised=()).__dict__
        )
    assert np.array_equal(model.vertices, other.vertices)
    assert np.array_equal(model.texture, other.texture)


# The gauge


def test_the_first_frame_does_not_move():
    estimates, state = known_run("rerendering", 8)
    first = state.keyframes[0]
    assert first.observation.index == 0
    np.testing.assert_array_equal(first.pose.matrix().numpy(), estimates[0].T_cam_obj)
    np.testing.assert_array_equal(revised(estimates)[0].T_cam_obj, estimates[0].T_cam_obj)
    np.testing.assert_allclose(estimates[0].T_cam_obj[:3, :3], np.eye(3), atol=1e-7)


def test_the_oldest_keyframe_does_not_move_in_the_paper_recipe():
    estimates, state = known_run("paper", 4)
    [keyframe] = state.keyframes
    np.testing.assert_array_equal(keyframe.pose.matrix().numpy(), estimates[0].T_cam_obj)


# The joint start


def test_first_frames_are_uncertain_until_they_are_solved_together_and_then_answered_anew():
    estimates, state = run(quick_solver("rerendering", solver={"init_frames": 4}), range(6))
    assert [len(estimate.revised) for estimate in estimates] == [0, 0, 0, 3, 0, 0]
    assert [better.index for better in estimates[3].revised] == [0, 1, 2]
    assert all(estimate.status is Status.UNCERTAIN for estimate in estimates[1:3])
    assert all("together" in estimate.reason for estimate in estimates[1:3])
    for better in estimates[3].revised:
        assert better.status is Status.TRACKED
        assert better.reason == ""
        assert better.revised == ()
        assert mask_iou(better.mask, true_mask(better.index)) > 0.7
    assert not np.array_equal(estimates[2].T_cam_obj, estimates[3].revised[2].T_cam_obj)
    assert state.waiting is None


def test_revised_answers_and_the_one_that_carries_them_are_one_solution():
    estimates, _ = known_run("rerendering", 3)
    together = {better.losses["laplacian"] for better in estimates[2].revised} | {
        estimates[2].losses["laplacian"]
    }
    assert len(together) == 1


def test_after_the_joint_start_its_own_motion_goes_on():
    estimates, state = known_run("rerendering", 3)
    (before, index), last = state.before, state.last[0]
    assert index == 1
    np.testing.assert_array_equal(before.matrix().numpy(), estimates[2].revised[1].T_cam_obj)
    np.testing.assert_array_equal(last.matrix().numpy(), estimates[2].T_cam_obj)


def test_a_video_that_ends_before_the_joint_start_has_a_result():
    solver = quick_solver("rerendering", solver={"init_frames": 8})
    estimates, state = run(solver, range(3))
    assert all(estimate.revised == () for estimate in estimates)
    assert (solver.result(state).texture_weight > 0).any()


# Memory


def observations_in(value: object, seen: set[int] | None = None) -> Iterator[Observation]:
    """Every observation that can be reached from a value."""
    seen = set() if seen is None else seen
    if id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, Observation):
        yield value
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from observations_in(getattr(value, field.name), seen)
    elif isinstance(value, (tuple, list, set)):
        for item in value:
            yield from observations_in(item, seen)
    elif isinstance(value, dict):
        for item in value.values():
            yield from observations_in(item, seen)


@pytest.mark.slow
@PRESETS
def test_memory_is_bounded_by_keyframes(preset):
    settings = {
        "keyframes": {"maximum": 3, "rotation": 0, "silhouette": 2.0},
        "learning_rates": dict.fromkeys(("translation", "rotation", "vertices", "texture"), 0.01),
        "tau": 2.0,
        "stop": "plateau",
        "iterations": 6,
        "init_frames": 1,
    }
    solver = quick_solver(preset, solver=settings)
    estimates, state = run(solver, range(15))
    held = list(observations_in(state))
    assert len(held) == len(state.keyframes) == 3
    assert sum(estimate.keyframe for estimate in estimates) > 10
    assert not list(observations_in(estimates))


@pytest.mark.slow
def test_memory_during_the_joint_start_is_bounded_by_its_frames():
    solver = quick_solver(
        "rerendering", solver={"init_frames": 5, "keyframes": {"maximum": 2, "rotation": 0}}
    )
    state = None
    for index in range(12):
        mask = estimate_of(true_mask(index))
        state, _ = (
            solver.init(frame(index), mask) if state is None else solver.step(state, frame(index), mask)
        )
        waiting = index + 1 if index < 4 else 0
        assert len(list(observations_in(state))) <= waiting + 2
    assert len(list(observations_in(state))) <= 2


@pytest.mark.slow
def test_frames_that_stay_lost_do_not_pile_up():
    _, state = run(quick_solver("rerendering", solver=FAILS), range(12))
    assert len(list(observations_in(state))) <= 3


# The object


@PRESETS
def test_the_object_is_a_closed_textured_mesh(preset):
    _, state = known_run(preset)
    model = quick_solver(preset).result(state)
    assert isinstance(model, ObjectModel)
    assert model.vertices.shape == (162, 3)
    assert model.faces.shape == (320, 3)
    assert model.face_uvs.shape == (320, 3, 2)
    assert (model.texture.shape, model.texture.dtype) == ((32, 32, 3), np.uint8)
    assert (model.texture_weight.shape, model.texture_weight.dtype) == ((32, 32), np.float32)
    assert (model.features.shape, model.features.dtype) == ((32, 32, 3), np.float32)
    assert trimesh.Trimesh(model.vertices, model.faces, process=False).is_watertight
    assert np.isfinite(model.vertices).all()


def test_the_visible_texture_is_that_of_the_video():
    sharp = {"frequency": 8, "texture_size": 100}
    solver = quick_solver("rerendering", crop={"size": 64}, object=sharp)
    estimates, state = run(solver, range(4))
    model = solver.result(state)
    camera = short_clip().camera
    T_cam_obj = torch.tensor(revised(estimates)[0].T_cam_obj).float()
    drawn = render(
        torch.tensor(model.vertices).float(),
        torch.tensor(model.faces),
        torch.tensor(model.face_uvs).float(),
        torch.tensor(model.texture).permute(2, 0, 1) / 255,
        T_cam_obj[None, :3, :3],
        T_cam_obj[None, :3, 3],
        torch.tensor(camera.K).float()[None],
        (camera.height, camera.width),
    )
    inside = (drawn.face_index[0] >= 0).numpy() & true_mask(0)
    shown = drawn.image()[0].permute(1, 2, 0).numpy()
    difference = np.abs(shown - frame(0).image / 255)[inside].mean()
    assert difference < 0.06
    assert 0.2 < (model.texture_weight > 0).mean() < 0.8  # one side was seen


def test_flat_prior_answers_with_a_flat_object():
    for preset in ("paper", "rerendering"):
        solver = quick_solver(preset, object={"flat": True})
        estimates, state = run(solver, range(5))
        vertices = solver.result(state).vertices
        spread = np.linalg.svd(vertices - vertices.mean(0), compute_uv=False)
        assert spread[2] < 1e-4 * spread[1]
        # Seen from the front at the start, not edge-on.
        assert all(mask_iou(estimate.mask, true_mask(estimate.index)) > 0.6 for estimate in estimates)


def test_answers_do_not_share_memory_with_what_was_given():
    solver = quick_solver()
    given = estimate_of(true_mask(0))
    _, estimate = solver.init(frame(0), given)
    assert isinstance(estimate, FrameEstimate)
    given.mask[:] = 0
    assert estimate.initial_mask.any()


def test_a_rendered_mask_that_differs_too_much_yields_to_the_initial_one():
    solver = quick_solver("rerendering", solver={"min_mask_iou": 0.8})
    initial = np.zeros((20, 20), dtype=bool)
    initial[5:15, 5:15] = True
    assessment = Assessment(Status.TRACKED, "", 0.9)
    near = initial.copy()
    near[5, 5:15] = False  # IoU 0.9
    kept, source, same = solver._assess_support(near, initial, assessment)
    assert kept is near and same is assessment and source is MaskSource.RENDERED
    far = np.roll(initial, 3, axis=1)  # IoU 70 / 130
    estimate, source, doubtful = solver._assess_support(far, initial, assessment)
    assert estimate is initial and source is MaskSource.INITIAL
    assert doubtful.status is Status.UNCERTAIN and "0.54" in doubtful.reason
    alone, _, _ = solver._assess_support(far, None, assessment)
    assert alone is far  # there is nothing to fall back on
