"""A map of some frames is extended over the frames around them, backwards and forwards."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from online_runs import FRAMES, Run, estimate_of, frame, run, solver, true_mask, turning_clip, with_true_masks

from tracking3d.estimation.online.mapping.focal_length import state_through_lens
from tracking3d.estimation.online.mapping.local_mapping import project_points
from tracking3d.estimation.online.state.solver_state import InactiveMap, SolverState
from tracking3d.estimation.solver import Gap
from tracking3d.geometry.pose import rotation_angle
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

FIRST, LAST = 5, 8
"""The frames before and after these are unknown to the map."""


@cache
def known() -> Run:
    """The run from frame ``FIRST`` to the end."""
    return run(with_true_masks(range(FIRST, FRAMES)))


def confidences(state: SolverState, value: float = 0.9) -> dict[int, float]:
    return dict.fromkeys(range(FIRST, state.last_pose[1] + 1), value)


def gap_before(anchor: int) -> Gap:
    """All frames before one."""
    indices = range(anchor - 1, -1, -1)
    return Gap(frame(anchor), ((frame(n), estimate_of(true_mask(n))) for n in indices), backwards=True)


@cache
def extended() -> Run:
    """The map after the frames before it, and their estimates."""
    begun = solver().begin_extension(known()[0], confidences(known()[0]))
    assert begun is not None
    state, explained = begun
    return solver().extend(state, gap_before(min(explained.anchors)))


def test_what_is_explained_are_the_frames_of_the_map_and_its_reliable_keyframes():
    state = known()[0]
    begun = solver().begin_extension(state, {**confidences(state), 0: 0.9, FIRST: 0.1})
    assert begun is not None
    _, explained = begun
    keyframes = {view.index for view in state.object_map.keyframes}
    assert FIRST in keyframes
    assert explained.anchors == keyframes - {FIRST}
    assert explained.confidence == {0: 0.9, **confidences(state), FIRST: 0.1}


def test_the_object_is_tracked_backwards_into_frames_before_the_first_one():
    _, estimates = extended()
    assert [estimate.index for estimate in estimates] == list(range(FIRST - 1, -1, -1))
    poses = {estimate.index: estimate.T_cam_obj for estimate in (*known()[1], *estimates)}
    found = np.stack([poses[index][:3, :3] for index in range(FIRST)])
    truth = turning_clip().T_cam_obj[:FIRST, :3, :3]
    assert aligned_rotation_errors(found, truth).max() < 5
    assert all(estimate.status == "tracked" for estimate in estimates)
    assert not any(estimate.mask.size for estimate in estimates), "a gap may be long"


def test_poses_of_both_sides_of_the_seam_are_of_one_object():
    state, estimates = extended()
    views = {view.index: view.pose for view in state.object_map.keyframes}
    found = np.stack([estimates[-1].T_cam_obj[:3, :3], views[max(views)].R.numpy()])
    truth = turning_clip().T_cam_obj[[0, max(views)], :3, :3]
    assert aligned_rotation_errors(found, truth).max() < 6


def test_new_keyframes_have_the_indices_of_their_frames_and_come_in_order_of_time():
    state, estimates = extended()
    indices = [view.index for view in state.object_map.keyframes]
    assert indices == sorted(set(indices))
    added = {estimate.index for estimate in estimates if estimate.keyframe}
    assert added
    assert added <= set(indices)
    assert indices[-1] < FRAMES


def test_a_gap_whose_keyframe_is_gone_has_no_estimates():
    state = known()[0]
    anchor = next(n for n in range(FRAMES) if all(view.index != n for view in state.object_map.keyframes))
    same, estimates = solver().extend(state, replace(gap_before(1), anchor=frame(anchor)))
    assert same is state
    assert estimates == []


@pytest.mark.parametrize("change", ["pointless", "fixed_keyframes"])
def test_a_map_without_points_and_one_of_a_known_object_are_not_extended(change):
    state = known()[0]
    state = replace(state, object_map=replace(state.object_map, **{change: 1}))
    assert solver().begin_extension(state, confidences(state)) is None


def test_an_object_that_has_no_map_yet_is_not_extended():
    state = run(with_true_masks(range(2)))[0]
    assert solver().begin_extension(state, {0: 0.3, 1: 0.3}) is None


def test_keyframes_that_nothing_supports_are_removed():
    state = known()[0]
    views = list(state.object_map.keyframes)
    nothing = np.zeros(len(views[-1].points), bool)
    views[-1] = replace(views[-1], points=views[-1].points.only(nothing))
    state = replace(state, object_map=replace(state.object_map, keyframes=tuple(views)))
    doubted = confidences(state) | {views[-1].index: 0.1}
    begun, _ = solver().begin_extension(state, doubted)
    assert views[-1].index not in [view.index for view in begun.object_map.keyframes]
    begun, _ = solver().begin_extension(state, confidences(state))
    assert views[-1].index in [view.index for view in begun.object_map.keyframes]


def with_inactive_map(state: SolverState, first: int, last: int) -> SolverState:
    """A state with a second map, of these frames."""
    assert state.surface is not None
    other = InactiveMap(state.object_map, state.surface, state.baseline, ((first, last),), unaligned=True)
    return replace(state, inactive_maps=(other,))


def test_a_map_is_given_up_if_the_largest_one_finds_the_object_in_half_of_its_frames():
    state = with_inactive_map(known()[0], 0, 3)
    assert len(solver().end_extension(state, {0}, FRAMES - 1).inactive_maps) == 1
    ended = solver().end_extension(state, {0, 2}, FRAMES - 1)
    assert ended.inactive_maps == ()
    assert (0, 3) in ended.spans


def test_refinement_starts_from_the_poses_that_were_found():
    state, estimates = extended()
    found = {estimate.index: np.asarray(estimate.T_cam_obj, np.float64) for estimate in estimates}
    state = solver().start_from(solver().end_extension(state, set(found), FRAMES - 1), found)
    state = solver().refine(state)
    wrong = np.eye(4)
    wrong[2, 3] = 5.0
    refined = []
    for index in range(FRAMES):
        causal = wrong if index in found else known()[1][index - FIRST].T_cam_obj
        state, estimate = solver().refine_frame(state, frame(index), estimate_of(true_mask(index)), causal)
        refined.append(estimate.T_cam_obj[:3, :3])
    errors = aligned_rotation_errors(np.stack(refined), turning_clip().T_cam_obj[:, :3, :3])
    assert errors.max() < 4


def test_a_second_initialization_that_finds_another_lens_moves_the_lost_map_to_it():
    state = with_inactive_map(known()[0], 0, 3)
    longer = state.camera.zoom(1.5, "found later")
    moved = state_through_lens(state, longer)
    assert moved.camera == longer
    for views, other in (
        (moved.object_map.keyframes, state.object_map.keyframes),
        (moved.inactive_maps[0].object_map.keyframes, state.inactive_maps[0].object_map.keyframes),
    ):
        for now, before in zip(views, other, strict=True):
            centre = np.zeros((1, 3))
            here = project_points(centre, now.pose, longer)
            assert here == pytest.approx(project_points(centre, before.pose, state.camera), abs=0.1)
            assert float(rotation_angle(now.pose.quaternion, before.pose.quaternion)) < 1e-6
    assert moved.trajectory[-1][0].translation[2] == pytest.approx(
        1.5 * float(state.trajectory[-1][0].translation[2])
    )


def test_the_same_lens_moves_nothing():
    state = known()[0]
    assert state_through_lens(state, state.camera) is state
