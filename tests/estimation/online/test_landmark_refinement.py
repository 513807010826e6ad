"""Dense landmarks put a map, its lens and the pose of a frame right, and leave them alone where they say too little."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from threading import Event

import numpy as np
import pytest
import torch
from online_runs import estimate_of, solver
from scipy.spatial.transform import Rotation

from tracking3d.estimation.online.mapping.focal_length import state_through_lens
from tracking3d.estimation.online.mapping.global_refinement import (
    adopt_refinement,
    refine_by_landmarks,
    refine_in_background,
)
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.mapping.local_mapping import project_points
from tracking3d.estimation.online.pose_tracking import resect_pose
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.estimation.online.tracker import Tracker
from tracking3d.frames import Frame
from tracking3d.geometry.pose import Pose, pose_from_arrays, rotation_angle
from tracking3d.runtime.background_attempt import BackgroundAttempt
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

FRAMES = 13


@cache
def clip() -> SyntheticClip:
    """A box with cut corners that turns by 72 degrees, 150 pixels large."""
    return synthesize(
        SyntheticSpec(frames=FRAMES, size=(320, 240), degrees_per_frame=6.0, drift=(0.2, -0.1, 0.2))
    )


@cache
def tracked() -> SolverState:
    """The state after the clip."""
    online = OnlineSolver(solver().config, clip().camera, solver().encoder)
    frames = [Frame(index, image) for index, image in enumerate(clip().images)]
    masks = [estimate_of(mask) for mask in clip().masks]
    state, _ = online.init(frames[0], masks[0])
    for frame, mask in zip(frames[1:], masks[1:], strict=True):
        state, _ = online.step(state, frame, mask)
    return state


def disturbed(degrees: float = 2.0) -> SolverState:
    """The same with another rotation of every keyframe but the first, none of which was adjusted."""
    state, rng = tracked(), np.random.default_rng(0)
    keyframes = [replace(view, is_adjusted=False) for view in state.object_map.keyframes]
    for place, view in enumerate(keyframes[1:], 1):
        axis = rng.normal(size=3)
        keyframes[place] = replace(view, pose=turned(view.pose, degrees * axis / np.linalg.norm(axis)))
    object_map = replace(state.object_map, keyframes=tuple(keyframes), asked_landmarks=-1)
    return replace(state, object_map=object_map)


def refine(state: SolverState) -> SolverState:
    """With the default settings."""
    return refine_by_landmarks(state, solver().options)


def turned(pose: Pose, degrees: np.ndarray) -> Pose:
    """A pose whose object is turned about itself."""
    T = pose.matrix().numpy()
    R = Rotation.from_rotvec(degrees, degrees=True).as_matrix() @ T[:3, :3]
    return pose_from_arrays(R, T[:3, 3], pose.translation)


def rotation_errors(object_map: ObjectMap) -> np.ndarray:
    """Degrees, of each keyframe."""
    found = np.stack([view.pose.matrix().numpy()[:3, :3] for view in object_map.keyframes])
    true = clip().T_cam_obj[[view.index for view in object_map.keyframes], :3, :3]
    return aligned_rotation_errors(found, true)


def test_keyframes_that_are_turned_by_two_degrees_come_back():
    before = disturbed()
    once = refine(before)
    assert rotation_errors(before.object_map).mean() > 1.2
    assert rotation_errors(once.object_map).mean() < 0.35
    assert all(view.is_adjusted for view in once.object_map.keyframes)
    assert refine(once) is once  # nothing is new


def centre(state: SolverState) -> torch.Tensor:
    """``(3,)`` of the object."""
    return state.object_map.vertices.mean(0)


def test_the_first_keyframe_stays_and_the_last_pose_is_that_of_the_newest():
    before = disturbed()
    after = refine(replace(before, last_pose=(before.last_pose[0], newest(before).index)))
    first, same = before.object_map.keyframes[0].pose, after.object_map.keyframes[0].pose
    assert float(rotation_angle(first.quaternion, same.quaternion)) < 1e-4
    assert torch.allclose(first.translation, same.translation, atol=1e-4)
    assert after.last_pose == (newest(after).pose, newest(after).index)


def newest(state: SolverState) -> Keyframe:
    """The last keyframe."""
    return state.object_map.keyframes[-1]


def test_the_landmarks_of_the_map_are_triangulated_again():
    object_map = refine(disturbed()).object_map
    gaps = []
    for view in object_map.keyframes:
        several = object_map.sightings[view.points.landmark] > 2
        names = view.points.landmark[several & ~object_map.candidate[view.points.landmark]]
        at = project_points(object_map.landmarks[names], view.pose, clip().camera)
        shown = view.points.pixel[np.isin(view.points.landmark, names)]
        gaps.append(np.linalg.norm(at - shown, axis=1))
    assert np.nanmedian(np.concatenate(gaps)) < 0.6


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_focal_length_that_nobody_gave_is_found_and_the_state_moves_with_it(factor):
    state = tracked()
    wrong = replace(clip().camera.zoom(factor, "assumed"), assumed=True)
    object_map = replace(state.object_map, asked_landmarks=-1)
    off = state_through_lens(replace(state, object_map=object_map), wrong)
    found = refine(off)
    for _ in range(3):
        found = replace(found, object_map=replace(found.object_map, asked_landmarks=-1))
        found = refine(found)
    assert abs(np.log(found.camera.fy / clip().camera.fy)) < 0.4 * abs(np.log(factor))
    assert found.camera.assumed
    assert torch.allclose(
        centre(found), centre(state), atol=0.1 * object_map.radius
    )  # not moved along the rays
    origin = np.zeros((1, 3))
    before = {index: pose for pose, index in state.trajectory}
    pose, index = found.trajectory[-1]
    there = project_points(origin, pose, found.camera)
    assert there == pytest.approx(project_points(origin, before[index], state.camera), abs=2.0)


def test_a_given_focal_length_stays():
    assert refine(disturbed()).camera == clip().camera


def test_images_that_show_nothing_leave_the_map_as_it_is():
    before = disturbed()
    blank = []
    for view in before.object_map.keyframes:
        assert view.image is not None
        blank.append(replace(view, image=replace(view.image, image=np.full_like(view.image.image, 90))))
    before = replace(before, object_map=replace(before.object_map, keyframes=tuple(blank)))
    after = refine(before)
    assert after.object_map.keyframes == before.object_map.keyframes
    assert after.object_map.vertices is before.object_map.vertices
    assert refine(after) is after  # they are not asked again before there are new ones


def test_keyframes_without_a_window_keep_their_poses():
    before = disturbed()
    views = list(before.object_map.keyframes)
    views[2] = replace(views[2], image=None)
    before = replace(before, object_map=replace(before.object_map, keyframes=tuple(views)))
    after = refine(before).object_map
    assert after.keyframes[2].pose is views[2].pose
    assert [view.is_adjusted for view in after.keyframes].count(False) == 1


@pytest.mark.parametrize("change", [{"pointless": True}, {"fixed_keyframes": 2}])
def test_maps_without_points_and_known_objects_are_not_asked(change):
    state = disturbed()
    state = replace(state, object_map=replace(state.object_map, **change))
    assert refine(state) is state


def test_in_a_large_map_one_new_keyframe_is_not_enough():
    state = disturbed()
    views = state.object_map.keyframes
    many = tuple(
        replace(view, observation=replace(view.observation, index=index))
        for index, view in enumerate(views * 5)
    )
    object_map = replace(state.object_map, keyframes=many, asked_landmarks=len(many) - 2)
    state = replace(state, object_map=object_map)
    assert len(many) > 20
    assert refine(state) is state


def test_local_mapping_keeps_the_poses_that_landmarks_have_adjusted():
    object_map = refine(disturbed()).object_map
    views = list(object_map.keyframes)
    views[-1] = replace(views[-1], pose=turned(views[-1].pose, np.array([0.0, 2.0, 0.0])), is_adjusted=False)
    object_map = replace(object_map, keyframes=tuple(views))
    everything = list(range(len(views)))
    refined = refine_local_map(
        object_map, clip().camera, everything, solver().options, bundle_iterations=10, rounds=1
    )
    for before, after in zip(views[:-1], refined.keyframes, strict=False):
        assert float(rotation_angle(before.pose.quaternion, after.pose.quaternion)) < 1e-5
    moved = rotation_angle(views[-1].pose.quaternion, refined.keyframes[-1].pose.quaternion)
    assert float(moved) > np.radians(1.0)


def between() -> tuple[ObjectMap, Keyframe, Pose]:
    """A refined map, a frame that did not make it, and its pose with the true rotation in the map's object frame."""
    state = disturbed()
    views = state.object_map.keyframes
    place = len(views) // 2
    others = replace(state.object_map, keyframes=views[:place] + views[place + 1 :])
    object_map = refine(replace(state, object_map=others)).object_map
    R_true = clip().T_cam_obj[[views[0].index, views[place].index], :3, :3]
    R = R_true[1] @ R_true[0].T @ views[0].pose.matrix().numpy()[:3, :3]
    tracked_view = tracked().object_map.keyframes[place]
    t = tracked_view.pose.matrix().numpy()[:3, 3]
    return object_map, tracked_view, pose_from_arrays(R, t, tracked_view.pose.translation)


@pytest.mark.parametrize("degrees", [0.5, 1.2, 2.0])
def test_a_frame_is_resected_from_the_nearest_keyframes(degrees):
    object_map, view, true = between()
    off = turned(true, degrees * np.array([0.6, 0.64, 0.48]))
    found = resect_pose(object_map, clip().camera, view, off)
    assert np.degrees(float(rotation_angle(found.quaternion, true.quaternion))) < 0.35


def test_a_frame_that_shows_something_else_keeps_its_fitted_pose():
    object_map, view, true = between()
    assert view.image is not None
    noise = np.random.default_rng(1).integers(0, 255, view.image.image.shape, dtype=np.uint8)
    other = replace(view, image=replace(view.image, image=noise))
    assert resect_pose(object_map, clip().camera, other, true) is true
    assert resect_pose(object_map, clip().camera, replace(view, image=None), true) is true


def test_a_correction_that_is_too_large_is_not_taken():
    object_map, view, true = between()
    off = turned(true, 4.0 * np.array([0.6, 0.64, 0.48]))
    assert resect_pose(object_map, clip().camera, view, off) is off


@pytest.mark.parametrize("lost", [False, True])
def test_of_the_frames_that_are_refined_lost_ones_alone_are_searched_as_a_whole(monkeypatch, lost):
    state, searched = tracked(), []
    monkeypatch.setattr(Tracker, "_elsewhere", lambda *given: searched.append(given))
    monkeypatch.setattr(PoseCandidate, "doubtful", True)
    monkeypatch.setattr(PoseCandidate, "lost", lost)
    online, frame = OnlineSolver(solver().config, clip().camera, solver().encoder), clip().images[4]
    T_cam_obj = state.last_pose[0].matrix().numpy()
    online.refine_frame(state, Frame(4, frame), estimate_of(clip().masks[4]), T_cam_obj)
    assert bool(searched) == lost


@pytest.mark.parametrize("is_given", [True, False])
def test_another_thread_refines_the_same_and_poses_move_with_the_last_keyframe(is_given):
    state = disturbed()
    if not is_given:
        wrong = replace(clip().camera.zoom(0.7, "assumed"), assumed=True)
        state = state_through_lens(state, wrong)
    begun = refine_in_background(state, solver().options)
    assert begun.object_map is state.object_map and begun.refinement is not None
    found, expected = adopt_refinement(begun, wait=None), refine(state)
    assert found.refinement is None and found.camera == expected.camera
    assert (found.camera == state.camera) == is_given
    assert torch.equal(found.object_map.vertices, expected.object_map.vertices)

    def from_keyframe(state):
        last, keyframe = state.last_pose[0].matrix(), state.object_map.keyframes[-1].pose.matrix()
        return last @ torch.linalg.inv(keyframe)

    through = state_through_lens(state, found.camera)
    assert torch.allclose(from_keyframe(found), from_keyframe(through), atol=1e-4)
    assert not torch.allclose(found.last_pose[0].matrix(), through.last_pose[0].matrix(), atol=1e-3)


def test_a_refinement_that_fails_leaves_the_map_as_it_is():
    state = tracked()
    failing = BackgroundAttempt(lambda: 1 / 0, None)
    left = adopt_refinement(replace(state, refinement=(state.object_map, failing)), wait=None)
    assert left.refinement is None and left.object_map is state.object_map


def test_a_refinement_of_another_map_or_of_none_is_dropped():
    state = disturbed()
    begun = refine_in_background(state, solver().options)
    other = replace(begun, object_map=replace(state.object_map))
    assert adopt_refinement(other, wait=None).object_map is other.object_map
    done = replace(state.object_map, asked_landmarks=state.object_map.keyframes[-1].index)
    assert refine_in_background(replace(state, object_map=done), solver().options).refinement is None


def test_a_live_source_gets_no_keyframe_while_its_map_is_refined(monkeypatch):
    monkeypatch.setattr("tracking3d.estimation.online.solver.needs_keyframe", lambda *_: True)
    live, state = solver().for_live_source(), tracked()
    index = state.last_pose[1] + 1
    image, mask = clip().images[-1], estimate_of(clip().masks[-1])
    busy = BackgroundAttempt(lambda: (Event().wait(0.5), ()), None)
    waiting = replace(state, refinement=(state.object_map, busy))
    assert not live.step(waiting, Frame(index, image), mask)[1].keyframe
    begun, estimate = live.step(state, Frame(index, image), mask)
    assert estimate.keyframe and begun.refinement is not None
    ended, _ = live.finish_background_work(begun)
    assert ended.refinement is None and ended.object_map.asked_landmarks == index
