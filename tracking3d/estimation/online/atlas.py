"""The atlas: if a lost object reappears from an unknown side, the solver initializes a second map of it.

The transform between the two maps is only a guess at first: the object is assumed to have kept rotating. One map is
active, the others are inactive. If the object shows a side that both maps know, they are merged. Estimates against a
map that is never merged stay as they are.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.estimate import UNALIGNED_MAP, FrameEstimate, Status
from tracking3d.estimation.online.features.klt import MOST_FOLLOWED, PLAIN, FollowedPoints, texture_strength
from tracking3d.estimation.online.features.sift import match
from tracking3d.estimation.online.mapping.focal_length import inactive_map_through_lens
from tracking3d.estimation.online.mapping.global_refinement import keyframe_cost, refine_globally
from tracking3d.estimation.online.mapping.keyframe_insertion import (
    cull_keyframes,
    prune_landmarks,
    refine_local_map,
)
from tracking3d.estimation.online.mapping.local_mapping import nearest_views, project_points
from tracking3d.estimation.online.pose_tracking import extrapolate_motion, pixel_scale
from tracking3d.estimation.online.relocalization import poses_from_matches
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS, LossBaseline
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, Mapped
from tracking3d.estimation.segmentation import as_lab
from tracking3d.frames import TRACKED_CONFIDENCE, Frame, mask_iou_or_none
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays
from tracking3d.geometry.similarity import Similarity

_MAX_UNALIGNED_CONFIDENCE = 0.05  # highest confidence while the transform between two maps is only a guess
_MAX_INACTIVE = 4
_UNALIGNED_REASON = (
    "re-initialized after tracking was lost; the pose relative to the earlier map is unknown until a known side is "
    "seen"
)


def guess_alignment(state: Mapped, begun: Mapped) -> Similarity:
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


def switch_map(state: Mapped, begun: Mapped, similarity: Similarity) -> Mapped:
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
    return begun.moved(
        object_map,
        lambda pose: transform_pose(pose, similarity),
        camera=state.camera,
        colours=state.colours,
        inactive_maps=_limit_maps(
            (*state.inactive_maps, _deactivate(state, (*state.spans, (state.active_since, first - 1))))
        ),
        active_since=first,
        unaligned=True,
        tried=state.tried,
    )


def _deactivate(state: Mapped, spans: tuple[tuple[int, int], ...]) -> InactiveMap:
    """The active map as an inactive one."""
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


def activate_map(state: Mapped, other: InactiveMap, index: int) -> Mapped:
    """The state that continues from frame ``index`` with an inactive map; the object is still lost."""
    return replace(
        _with_active_map(state, other, (*state.spans, (state.active_since, index - 1))),
        lost_frames=max(state.lost_frames, 1),
        active_since=index,
        reinitialization=None,
    )


def map_of_frame(state: Mapped, index: int) -> Mapped:
    """The state after its last frame, with the map active that estimated frame ``index``."""
    if any(first <= index <= last for first, last in state.spans):
        return state
    for other in state.inactive_maps:
        if any(first <= index <= last for first, last in other.spans):
            return _with_active_map(state, other, state.spans)
    return state


def frames_of_map(state: Mapped, frames: Iterable[int]) -> Iterator[int]:
    """Those of some frames that were estimated with the active map."""
    return (index for index in frames if any(first <= index <= last for first, last in state.spans))


def activate_largest_map(state: Mapped) -> Mapped:
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


def _with_active_map(state: Mapped, other: InactiveMap, spans: tuple[tuple[int, int], ...]) -> Mapped:
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


_MIN_SHARED_LANDMARKS = 6  # fewest shared landmarks for the transform between two maps
_MAX_COMPARED = 24  # most keyframes of another map that a keyframe is compared with
_MAX_COST_RATIO = 1.2  # ratio of the keyframe costs up to which two maps are merged


def merge_maps(state: Mapped, config: OnlineConfig, views: tuple[Keyframe, ...]) -> Mapped:
    """The state after merging the active map with every map that some of its keyframes can be aligned to.

    Args:
        state: The state between two frames; its last frame is the newest keyframe.
        config: The solver's options.
        views: The keyframes of the active map that are compared with the others.
    """
    indices = {view.index for view in views}
    for other in state.inactive_maps:
        # Merging renumbers the landmarks, so the views change as well.
        for view in (view for view in state.object_map.keyframes if view.index in indices):
            similarity = _estimate_alignment(state.object_map, other.object_map, state.camera, view)
            object_map = (
                None if similarity is None else _merge_pair(state, other.object_map, similarity, config)
            )
            if similarity is not None and object_map is not None:
                state = _with_merged_map(state, other, similarity, object_map)
                break
    return state


def _estimate_alignment(
    object_map: ObjectMap, other: ObjectMap, camera: Camera, view: Keyframe
) -> Similarity | None:
    """The similarity from one map to another by the landmarks that one view shows of both; None if it shows too few."""
    count = len(other.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_COMPARED)).round().astype(int))
    compared = [other.keyframes[position] for position in chosen]
    found = poses_from_matches(other, camera, (view.keypoints,), compared, pixel_scale(view))
    if not found or len(found[0][1]) < ENOUGH_POINTS:
        return None
    pose, points = found[0]
    gap = np.linalg.norm(points.pixel[:, None] - view.keypoints.pixel[None], axis=2)
    label = np.where(gap.min(1) < 0.5, view.keypoint_landmark[gap.argmin(1)], -1)
    x_other, x_known = other.landmarks[points.landmark], object_map.landmarks[label]
    sound = (
        (label >= 0)
        & ~object_map.candidate[label]
        & np.isfinite(x_known).all(1)
        & np.isfinite(x_other).all(1)
    )
    if np.count_nonzero(sound) < _MIN_SHARED_LANDMARKS:
        return None
    x_other, x_known = x_other[sound], x_known[sound]
    R = pose_arrays(pose)[0].T @ pose_arrays(view.pose)[0]
    centre_other, centre_known = np.median(x_other, 0), np.median(x_known, 0)
    spread_other = np.median(np.linalg.norm(x_other - centre_other, axis=1))
    scale = float(spread_other / max(np.median(np.linalg.norm(x_known - centre_known, axis=1)), 1e-9))
    return Similarity(R, scale, np.median(x_other - scale * x_known @ R.T, 0))


def _merge_pair(
    state: Mapped, other: ObjectMap, similarity: Similarity, config: OnlineConfig
) -> ObjectMap | None:
    """Both maps as one, if that explains their keyframes nearly as well as two maps do."""
    camera, second = state.camera, transform_map(state.object_map, similarity)
    pairs = match_landmarks(other, second, camera)
    if len(pairs) < _MIN_SHARED_LANDMARKS:
        return None
    most = max(config.max_keyframes, len(other.keyframes))
    object_map = merge(other, second, pairs, most)
    everything = list(range(len(object_map.keyframes)))
    object_map = refine_local_map(object_map, camera, everything, config, bundle_iterations=20, rounds=3)
    alone = max(keyframe_cost(other), keyframe_cost(state.object_map))
    return object_map if keyframe_cost(object_map) < _MAX_COST_RATIO * alone else None


def _with_merged_map(
    state: Mapped, other: InactiveMap, similarity: Similarity, object_map: ObjectMap
) -> Mapped:
    newest = object_map.keyframes[-1]
    at_newest = newest.index == state.last_pose[1]
    points = newest.points.spread_out(MOST_FOLLOWED, float(newest.observation.window.side))
    usual = other.baseline if other.baseline.frames > state.baseline.frames else state.baseline
    return state.moved(
        object_map,
        lambda pose: transform_pose(pose, similarity),
        **({"last_pose": (newest.pose, newest.index)} if at_newest else {}),
        tracked_points=points if at_newest else FollowedPoints.none(),
        baseline=usual if usual.frames else LossBaseline(),
        inactive_maps=tuple(one for one in state.inactive_maps if one is not other),
        spans=(*state.spans, *other.spans),
        unaligned=state.unaligned and other.unaligned,
        reversal_attempt=(0, 0.0),
    )


_COMPARED_KEYFRAMES = 4  # keyframes of the first map that each of the second is compared with
_MAX_REPROJECTION_ERROR = 20.0  # pixels at an object size of 200, between both projections of a landmark

Pairs = NDArray[np.int64]
"""``(N, 2)`` indices of landmarks of the first and second map that are the same point of the object."""


def transform_map(object_map: ObjectMap, similarity: Similarity) -> ObjectMap:
    """A map in the coordinates that ``similarity`` leads to."""
    vertices = similarity.points(object_map.vertices.double().cpu().numpy())
    keyframes = [
        replace(view, pose=transform_pose(view.pose, similarity), texture=None)
        for view in object_map.keyframes
    ]
    return replace(
        object_map,
        vertices=torch.from_numpy(vertices).to(object_map.vertices),
        landmarks=similarity.points(object_map.landmarks),
        keyframes=tuple(keyframes),
        free_axis=None,  # it is found again
    )


def transform_pose(pose: Pose, similarity: Similarity) -> Pose:
    """A pose in the second map's coordinates as one in the first's."""
    R, t = pose_arrays(pose)
    T_cam_obj = np.eye(4)
    T_cam_obj[:3, :3], T_cam_obj[:3, 3] = R, t
    (T,) = similarity.poses(T_cam_obj[None])
    return pose_from_arrays(T[:3, :3], T[:3, 3], pose.translation)


def match_landmarks(first: ObjectMap, second: ObjectMap, camera: Camera) -> Pairs:
    """Shared landmarks: their keypoints match, and both maps project them to nearly the same pixel.

    Args:
        first: A map.
        second: Another map, in the coordinates of the first.
        camera: The camera of both.
    """
    votes: Counter[tuple[int, int]] = Counter()
    for view in second.keyframes:
        limit = _MAX_REPROJECTION_ERROR * max(1.0, view.observation.window.side / 200)
        for other in nearest_views(first.keyframes, view.pose, _COMPARED_KEYFRAMES):
            pairs = match(other.keypoints, view.keypoints)
            a, b = other.keypoint_landmark[pairs[:, 0]], view.keypoint_landmark[pairs[:, 1]]
            known = (a >= 0) & (b >= 0)
            a, b, pairs = a[known], b[known], pairs[known]
            sound = ~first.candidate[a] & ~second.candidate[b] & np.isfinite(first.landmarks[a]).all(1)
            a, b, pairs = a[sound], b[sound], pairs[sound]
            place = project_points(first.landmarks[a], view.pose, camera)
            near = np.linalg.norm(place - view.keypoints.pixel[pairs[:, 1]], axis=1) < limit
            votes.update(zip(a[near].tolist(), b[near].tolist(), strict=True))
    pairs_found, taken_first, taken_second = [], set[int](), set[int]()
    for (one, two), _ in votes.most_common():
        if one not in taken_first and two not in taken_second:
            pairs_found.append((one, two))
            taken_first.add(one)
            taken_second.add(two)
    return np.array(pairs_found, np.int64).reshape(-1, 2)


def merge(first: ObjectMap, second: ObjectMap, pairs: Pairs, most: int) -> ObjectMap:
    """The keyframes and landmarks of both maps, on the first map's surface.

    Args:
        first: A map.
        second: Another map, in the coordinates of the first, with features of the same kind.
        pairs: See `match_landmarks`.
        most: The most keyframes that are kept.
    """
    names = len(first.landmarks) + np.arange(len(second.landmarks))
    names[pairs[:, 1]] = pairs[:, 0]
    there = {view.index for view in first.keyframes}
    added = [_relabel(view, names) for view in second.keyframes if view.index not in there]
    keyframes = sorted((*first.keyframes, *added), key=lambda view: view.index)
    object_map = replace(
        first,
        landmarks=np.concatenate([first.landmarks, second.landmarks]),
        candidate=np.concatenate([first.candidate, second.candidate]),
        keyframes=tuple(replace(view, is_adjusted=False) for view in cull_keyframes(tuple(keyframes), most)),
        asked_landmarks=-1,
        pointless=first.pointless and second.pointless,
        free_axis=None,
        started_at_rest=first.started_at_rest or second.started_at_rest,
    )
    return prune_landmarks(object_map, FollowedPoints.none())[0]


def _relabel(view: Keyframe, names: NDArray[np.int64]) -> Keyframe:
    """A view with renumbered landmarks; of two that are now the same landmark, the first is kept."""
    landmark, first = np.unique(names[view.points.landmark], return_index=True)
    points = FollowedPoints(landmark, view.points.pixel[first])
    label = np.where(view.keypoint_landmark >= 0, names[view.keypoint_landmark], -1)
    return replace(view, points=points, keypoint_landmark=label)


_LASTING_DOUBT = 20  # doubtful frames in a row from which a map without points is doubted itself
_MIN_MASK_IOU = 0.3  # IoU of two frames' masks, below which they show different objects
_MIN_COLOUR_RATIO = -0.5  # mean log ratio of the colours, below which a mask shows another object


def needs_second_map(state: Mapped, image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> bool:
    """Whether a second map is begun, or continued, after a frame.

    It is if the object is lost. A map without points is given up if its poses have been doubtful for long, too, but
    only if there is texture now: another map without points would be no better.

    Args:
        state: After the frame.
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` of the object.
    """
    if state.object_map.fixed_keyframes:
        return False
    if not state.object_map.pointless:
        return state.lost
    doubted = state.lost or state.doubtful_frames >= _LASTING_DOUBT
    return doubted and texture_strength(image, mask) >= PLAIN


def masks_overlap(before: NDArray[np.bool_] | None, mask: NDArray[np.bool_]) -> bool:
    """Whether the masks ``(H, W)`` of two frames overlap enough to show the same object."""
    return (mask_iou_or_none(mask, before) or 0.0) > _MIN_MASK_IOU


def is_fully_visible(mask: NDArray[np.bool_]) -> bool:
    """Whether a mask ``(H, W)`` does not touch the frame's border: an object that enters shows little of itself."""
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(mask.any() and not border.any())


def colours_match(state: Mapped, frame: Frame, mask: NDArray[np.bool_]) -> bool:
    """Whether the colours inside a mask ``(H, W)`` do not contradict the object's colour model."""
    if state.colours is None:
        return True
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    crop = slice(y, y + height), slice(x, x + width)
    ratio = state.colours.log_ratio(as_lab(np.ascontiguousarray(frame.image[crop])))
    return float(ratio[mask[crop]].mean()) > _MIN_COLOUR_RATIO


def is_reliable(begun: Mapped, estimate: FrameEstimate) -> bool:
    """Whether a second initialization is reliable enough to continue with."""
    return not begun.object_map.pointless and estimate.confidence >= TRACKED_CONFIDENCE
