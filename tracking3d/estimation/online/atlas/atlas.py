"""The atlas: if a lost object reappears from an unknown side, the solver initializes a second map of it.

The transform between the two maps is only a guess at first: the object is assumed to have kept rotating. One map is
active, the others are inactive. If the object shows a side that both maps know, they are merged. Estimates against a
map that is never merged stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.estimate import UNALIGNED_MAP, FrameEstimate, Status
from tracking3d.estimation.online.atlas.map_merging import transform_map, transform_pose
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.focal_length import inactive_map_through_lens
from tracking3d.estimation.online.mapping.global_refinement import refine_globally
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, SolverState
from tracking3d.estimation.online.tracking.motion_model import extrapolate_motion
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays
from tracking3d.geometry.similarity import Similarity

_MAX_UNALIGNED_CONFIDENCE = 0.05  # highest confidence while the transform between two maps is only a guess
_MAX_INACTIVE = 4
_UNALIGNED_REASON = (
    "re-initialized after tracking was lost; the pose relative to the earlier map is unknown until a known side is "
    "seen"
)


def guess_alignment(state: SolverState, begun: SolverState) -> Similarity:
    """The guessed similarity from a new map to a lost one: equal size, and the rotation extrapolated over the gap.

    Args:
        state: The state with the lost map.
        begun: The state after the second initialization.
    """
    turns = []
    for view in begun.object_map.keyframes:
        R_before, _ = pose_arrays(extrapolate_motion(state.trajectory, view.index))
        turns.append(R_before.T @ pose_arrays(view.pose)[0])
    # The rotation nearest to all of the candidates.
    u, _, vt = np.linalg.svd(np.sum(turns, 0))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = _size(state.object_map) / _size(begun.object_map)
    centre_before, centre_anew = (
        object_map.vertices.double().mean(0).cpu().numpy()
        for object_map in (state.object_map, begun.object_map)
    )
    return Similarity(R, scale, centre_before - scale * R @ centre_anew)


def _size(object_map: ObjectMap) -> float:
    """The object's size up to a factor common to all of its maps: its extent in the image times its distance.

    The parts of a surface that no keyframe shows are a guess, and often far too deep or flat.
    """
    seen = [
        float(view.pose.translation[2]) * np.sqrt(np.count_nonzero(view.mask))
        for view in object_map.keyframes
        if view.mask is not None and view.mask.any()
    ]
    return float(np.median(seen)) if seen else 1.0


def switch_map(state: SolverState, begun: SolverState, similarity: Similarity) -> SolverState:
    """The state that continues with the map of a second initialization; the map before it becomes inactive.

    Args:
        state: The state with the lost map.
        begun: The state after the second initialization, in its own coordinates.
        similarity: From the new map's coordinates to the lost map's.
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
    """The active map as an inactive one."""
    assert state.surface is not None
    return InactiveMap(
        state.object_map, state.surface, state.baseline, spans, state.unaligned, state.mask_agreement
    )


def _limit_maps(aside: tuple[InactiveMap, ...]) -> tuple[InactiveMap, ...]:
    """At most `_MAX_INACTIVE` maps: those with the most keyframes, in their previous order."""
    fewest_first = sorted(aside, key=lambda other: len(other.object_map.keyframes))
    dropped = fewest_first[: max(len(aside) - _MAX_INACTIVE, 0)]
    return tuple(other for other in aside if not any(other is one for one in dropped))


def transform_estimates(estimate: FrameEstimate, similarity: Similarity, camera: Camera) -> FrameEstimate:
    """An estimate of a second initialization in the coordinates of the lost object."""
    T = similarity.poses(estimate.T_cam_obj[None].astype(np.float64))[0].astype(estimate.T_cam_obj.dtype)
    revised = tuple(transform_estimates(one, similarity, camera) for one in estimate.revised)
    return replace(estimate, T_cam_obj=T, camera=camera, revised=revised)


def mark_unaligned(estimate: FrameEstimate) -> FrameEstimate:
    """An estimate against a map whose transform to the first one is a guess: lost, however good its mask is."""
    if estimate.revised:
        estimate = replace(estimate, revised=tuple(map(mark_unaligned, estimate.revised)))
    if estimate.status is Status.LOST:
        return estimate
    return replace(
        estimate,
        status=Status.LOST,
        reason=_UNALIGNED_REASON,
        confidence=min(estimate.confidence, _MAX_UNALIGNED_CONFIDENCE),
        diagnostics=dict(estimate.diagnostics) | {UNALIGNED_MAP: estimate.confidence},
    )


def activate_map(state: SolverState, other: InactiveMap, index: int) -> SolverState:
    """The state that continues from frame ``index`` with an inactive map; the object is still lost."""
    return replace(
        _with_active_map(state, other, (*state.spans, (state.active_since, index - 1))),
        lost_frames=max(state.lost_frames, 1),
        active_since=index,
        reinitialization=None,
    )


def map_of_frame(state: SolverState, index: int) -> SolverState:
    """The state after its last frame, with the map active that estimated frame ``index``."""
    if any(first <= index <= last for first, last in state.spans):
        return state
    for other in state.inactive_maps:
        if any(first <= index <= last for first, last in other.spans):
            return _with_active_map(state, other, state.spans)
    return state


def frames_of_map(state: SolverState, frames: Iterable[int]) -> Iterator[int]:
    """Those of some frames that were estimated with the active map."""
    return (index for index in frames if any(first <= index <= last for first, last in state.spans))


def activate_largest_map(state: SolverState) -> SolverState:
    """The state with the map of most keyframes active, the earlier one of equals; the mesh is made from it."""

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
    """Refine all keyframes of an inactive map together, with the final focal length.

    Its transform to the map that the mesh is made from is a guess, whichever of the two was first.
    """
    other = inactive_map_through_lens(other, before, after)
    object_map, _ = refine_globally(other.object_map, replace(after, assumed=False), config)
    return replace(other, object_map=object_map, surface=object_map.surface(), unaligned=True)


def _with_active_map(
    state: SolverState, other: InactiveMap, spans: tuple[tuple[int, int], ...]
) -> SolverState:
    """The state with another map active; the active one, which estimated ``spans``, becomes inactive."""
    newest = other.object_map.keyframes[-1]
    return replace(
        state,
        trajectory=((newest.pose, newest.index),),
        object_map=other.object_map,
        surface=other.surface,
        revisable=(),
        baseline=other.baseline,
        mask_agreement=other.mask_agreement,
        unaligned=other.unaligned,
        spans=other.spans,
        inactive_maps=(*(one for one in state.inactive_maps if one is not other), _deactivate(state, spans)),
        previous_pose=None,
        tracked_points=FollowedPoints.none(),
        motion_references=(),
        last_candidate=None,
    )
