"""An object that was lost and is seen again from a side that nobody knows: a second start, with a map of its own.

How the second map lies to the first is a guess at first: the object is taken to have gone on turning as it did. While
one of them is tracked against, the others stand aside. Where a side that one of them knows is met in the other, both
become one. What is never joined stays as it was answered.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.estimate import UNALIGNED_MAP, FrameEstimate, Status
from tracking3d.estimation.online.atlas.map_merging import transform_map, transform_pose
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.global_refinement import refine_globally
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, SolverState
from tracking3d.estimation.online.tracking.motion_model import extrapolate_motion
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays
from tracking3d.geometry.similarity import Similarity

_UNPROVEN = 0.05  # confidence at most while how two maps lie to each other is a guess
_MOST_ASIDE = 4
_REASON = (
    "re-initialized after tracking was lost; the pose relative to the earlier map is unknown until a known side is "
    "seen"
)


def guess_alignment(state: SolverState, begun: SolverState) -> Similarity:
    """From a second start's coordinates to those of a lost map: as large, and turned on as it did before the loss.

    Args:
        state: With the lost map.
        begun: The second start.
    """
    turns = []
    for view in begun.object_map.keyframes:
        R_before, _ = pose_arrays(extrapolate_motion(state.trajectory, view.index))
        turns.append(R_before.T @ pose_arrays(view.pose)[0])
    # The rotation nearest to all of them.
    u, _, vt = np.linalg.svd(np.sum(turns, 0))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = _size(state.object_map) / _size(begun.object_map)
    centre_before, centre_anew = (
        object_map.vertices.double().mean(0).cpu().numpy()
        for object_map in (state.object_map, begun.object_map)
    )
    return Similarity(R, scale, centre_before - scale * R @ centre_anew)


def _size(object_map: ObjectMap) -> float:
    """How large the object is, but for a factor that is the same for all of its maps: as seen, at its distance.

    What no view shows of a surface is a guess, and often far too deep or flat.
    """
    seen = [
        float(view.pose.translation[2]) * np.sqrt(np.count_nonzero(view.mask))
        for view in object_map.keyframes
        if view.mask is not None and view.mask.any()
    ]
    return float(np.median(seen)) if seen else 1.0


def switch_map(state: SolverState, begun: SolverState, similarity: Similarity) -> SolverState:
    """The belief that goes on with a second start; the map of before stands aside.

    Args:
        state: With the lost map.
        begun: The second start, in its own coordinates.
        similarity: From those to the lost map's.
    """
    shape = begun.object_map.shape
    rest = torch.from_numpy(similarity.points(shape.rest.double().cpu().numpy())).to(shape.rest)
    object_map = replace(transform_map(begun.object_map, similarity), shape=replace(shape, rest=rest))
    first = object_map.keyframes[0].index
    before, now = begun.previous_pose, begun.last_pose
    return replace(
        begun,
        camera=state.camera,
        object_map=object_map,
        surface=object_map.surface(),
        last_pose=(transform_pose(now[0], similarity), now[1]),
        previous_pose=before and (transform_pose(before[0], similarity), before[1]),
        trajectory=tuple((transform_pose(pose, similarity), index) for pose, index in begun.trajectory),
        colours=state.colours,
        inactive_maps=_limit_maps(
            (*state.inactive_maps, _deactivate(state, (*state.spans, (state.active_since, first - 1))))
        ),
        active_since=first,
        unaligned=True,
    )


def _deactivate(state: SolverState, spans: tuple[tuple[int, int], ...]) -> InactiveMap:
    """The present map as one that stands aside."""
    assert state.surface is not None
    return InactiveMap(state.object_map, state.surface, state.baseline, spans, state.unaligned)


def _limit_maps(aside: tuple[InactiveMap, ...]) -> tuple[InactiveMap, ...]:
    """Not more than a few maps: those with most keyframes, in the order that they were in."""
    fewest_first = sorted(aside, key=lambda other: len(other.object_map.keyframes))
    dropped = fewest_first[: max(len(aside) - _MOST_ASIDE, 0)]
    return tuple(other for other in aside if not any(other is one for one in dropped))


def transform_estimates(estimate: FrameEstimate, similarity: Similarity, camera: Camera) -> FrameEstimate:
    """Answers of a second start as of the lost object."""
    T = similarity.poses(estimate.T_cam_obj[None].astype(np.float64))[0].astype(estimate.T_cam_obj.dtype)
    revised = tuple(transform_estimates(one, similarity, camera) for one in estimate.revised)
    return mark_unaligned(replace(estimate, T_cam_obj=T, camera=camera, revised=revised))


def mark_unaligned(estimate: FrameEstimate) -> FrameEstimate:
    """An answer against a map of which it is a guess how it lies to the first: lost, whatever its mask is worth."""
    if estimate.status is Status.LOST:
        return estimate
    return replace(
        estimate,
        status=Status.LOST,
        reason=_REASON,
        confidence=min(estimate.confidence, _UNPROVEN),
        diagnostics=dict(estimate.diagnostics) | {UNALIGNED_MAP: 1.0},
    )


def activate_map(state: SolverState, other: InactiveMap, index: int) -> SolverState:
    """The belief that goes on from frame ``index`` with a map that stood aside; the object is still lost."""
    return replace(
        _with_active_map(state, other, (*state.spans, (state.active_since, index - 1))),
        lost_frames=max(state.lost_frames, 1),
        active_since=index,
        reinitialization=None,
    )


def map_of_frame(state: SolverState, index: int) -> SolverState:
    """The belief, past its last frame, with the map that answered frame ``index``."""
    if any(first <= index <= last for first, last in state.spans):
        return state
    for other in state.inactive_maps:
        if any(first <= index <= last for first, last in other.spans):
            return _with_active_map(state, other, state.spans)
    return state


def activate_largest_map(state: SolverState) -> SolverState:
    """The belief with the map of most keyframes, of two the earlier; of it the mesh is made."""

    def rank(object_map: ObjectMap, since: int) -> tuple[int, int]:
        return len(object_map.keyframes), -since

    largest = max(
        state.inactive_maps, key=lambda other: rank(other.object_map, other.spans[0][0]), default=None
    )
    since = state.spans[0][0] if state.spans else state.active_since
    if largest is None or rank(largest.object_map, largest.spans[0][0]) <= rank(state.object_map, since):
        return state
    return _with_active_map(state, largest, state.spans or ((state.active_since, state.last_pose[1]),))


def refine_inactive_map(
    other: InactiveMap, before: Camera, after: Camera, config: OnlineConfig
) -> InactiveMap:
    """A map that stands aside, through the lens of the end and all its keyframes together once more.

    How it lies to the one that the mesh is made of is a guess, whichever of them was the first.
    """
    keyframes = other.object_map.keyframes
    if after != before:
        keyframes = tuple(with_focal_length(view, before, after) for view in keyframes)
    object_map = replace(other.object_map, keyframes=keyframes)
    object_map, _ = refine_globally(object_map, replace(after, assumed=False), config)
    return replace(other, object_map=object_map, surface=object_map.surface(), unaligned=True)


def _with_active_map(
    state: SolverState, other: InactiveMap, spans: tuple[tuple[int, int], ...]
) -> SolverState:
    """The belief with another map, and the present one, which answered ``spans``, aside."""
    newest = other.object_map.keyframes[-1]
    return replace(
        state,
        trajectory=((newest.pose, newest.index),),
        object_map=other.object_map,
        surface=other.surface,
        baseline=other.baseline,
        unaligned=other.unaligned,
        spans=other.spans,
        inactive_maps=(*(one for one in state.inactive_maps if one is not other), _deactivate(state, spans)),
        previous_pose=None,
        tracked_points=FollowedPoints.none(),
        motion_references=(),
        last_candidate=None,
    )
