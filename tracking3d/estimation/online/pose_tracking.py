"""The pose of one frame against the map: cheap hypotheses first, costly ones only if those look wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints, follow, grey, has_texture
from tracking3d.estimation.online.mapping.keyframe_insertion import draw_keyframe, draw_keyframes
from tracking3d.estimation.online.mapping.local_mapping import (
    is_well_inside,
    nearest_views,
    project_points,
    to_window,
)
from tracking3d.estimation.online.optimization.pnp import pose_from_points, pose_of_tracks
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose, refine_poses, render_cost
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.state.confidence import PoseCandidate, PoseEvidence
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, extrapolate, pose_arrays, pose_from_arrays, rotation_angle
from tracking3d.points.landmark_adjustment import resect
from tracking3d.rendering import MatchedPoints, Surface

ENOUGH_MATURE = 30
"""If so many landmarks were seen by two keyframes or more, landmarks seen by only one are not used."""
_MIN_INLIERS = 6  # fewest points of a pose by PnP
_MAX_INLIER_ERROR = 3.0  # largest reprojection error of an inlier, in pixels at an object size of 200 pixels
_OUTLINE_MARGIN = 8.0  # such pixels from the outline within which points slide over the surface
# Such pixels, beyond which a point is an outlier
_MAX_REPROJECTION_ERROR, _MAX_REPROJECTION_ERROR_NEW = 4.0, 16.0
_NEAR_SCALES = 4.0, 1.0  # such pixels at which a point's loss is log 2, one after the other (chosen)
# Taken off the cost for each inlier, and for how many at most
_INLIER_REWARD, _MAX_REWARDED_INLIERS = 0.005, 30


def pixel_scale(view: Keyframe) -> float:
    """A view's window size relative to 200 pixels, at least 1. Tolerances in pixels scale with it."""
    return max(1.0, view.observation.window.side / 200)


def fit_pose(
    object_map: ObjectMap,
    surface: Surface,
    view: Keyframe,
    starts: dict[str, Pose],
    points: FollowedPoints,
    weights: PoseWeights,
    iterations: tuple[int, ...] = (4, 5),
) -> tuple[str, PoseFit]:
    """The best initial pose, and the pose refined from it; for the iterations see `refine_poses`."""
    weights = replace(weights, outline=weights.outline * view.mask_weight)
    matched = _matched_points(object_map, surface, view, points)
    name = next(iter(starts))
    if len(starts) > 1:
        fits = refine_poses(surface, view.observation, list(starts.values()), matched, weights, (0,))
        name, _ = min(zip(starts, fits, strict=True), key=lambda one: one[1].cost)
    return name, refine_pose(surface, view.observation, starts[name], matched, weights, iterations)


def pose_of_points(
    object_map: ObjectMap, camera: Camera, points: FollowedPoints, scale: float
) -> tuple[Pose, FollowedPoints] | None:
    """The pose with most inliers by PnP, and the inliers; for the scale see `pixel_scale`."""
    position = object_map.landmarks[points.landmark]
    if np.isfinite(position).all(1).sum() < _MIN_INLIERS:
        return None
    found = pose_from_points(
        position, points.pixel.astype(np.float64), camera.K, threshold=_MAX_INLIER_ERROR * scale, seed=0
    )
    if found is None or found.count < _MIN_INLIERS:
        return None
    return pose_from_arrays(found.R, found.t, object_map.vertices), points.only(found.inliers)


def pose_near(object_map: ObjectMap, camera: Camera, view: Keyframe) -> Pose | None:
    """The pose of least reprojection error near the one that a view has; None without landmarks enough for it."""
    points = view.points.only(_is_mature(object_map, view.points))
    if len(points) < ENOUGH_MATURE:
        return None
    position, pixel = object_map.landmarks[points.landmark], points.pixel.astype(np.float64)
    R, t = pose_arrays(view.pose)
    for scale in _NEAR_SCALES:
        found = pose_of_tracks(position, pixel, None, camera.K, R, t, scale * pixel_scale(view))
        R, t = found.R, found.t
    return pose_from_arrays(R, t, object_map.vertices)


def _is_mature(object_map: ObjectMap, points: FollowedPoints) -> NDArray[np.bool_]:
    """``(N,)`` whether points are landmarks on the object that at least two keyframes have seen."""
    seen = np.isfinite(object_map.landmarks[points.landmark]).all(1) & ~object_map.candidate[points.landmark]
    return np.asarray(seen & (object_map.sightings[points.landmark] >= 2))


def find_inliers(
    object_map: ObjectMap, camera: Camera, pose: Pose, points: FollowedPoints, view: Keyframe
) -> FollowedPoints:
    """Points whose reprojection error is small and that lie off the outline; candidate landmarks are not used."""
    if not len(points):
        return points
    gap = np.linalg.norm(
        project_points(object_map.landmarks[points.landmark], pose, camera) - points.pixel, axis=1
    )
    young = object_map.sightings[points.landmark] < 2
    scale = pixel_scale(view)
    in_place = np.isnan(gap) | (
        gap < np.where(young, _MAX_REPROJECTION_ERROR_NEW, _MAX_REPROJECTION_ERROR) * scale
    )
    inside = is_well_inside(
        view.mask, object_map.silhouette(pose, camera), points.pixel, _OUTLINE_MARGIN * scale
    )
    return points.only(in_place & (inside | object_map.candidate[points.landmark]))


def pose_evidence(
    object_map: ObjectMap, camera: Camera, pose: Pose, agree: FollowedPoints, view: Keyframe
) -> PoseEvidence:
    """The evidence for a pose apart from its losses; ``agree`` are its inliers."""
    told = view.points.only(_is_mature(object_map, view.points))
    gap = project_points(object_map.landmarks[told.landmark], pose, camera) - told.pixel
    stray = np.linalg.norm(gap, axis=1) > _MAX_REPROJECTION_ERROR * pixel_scale(view)
    strays = float(stray.mean()) if len(stray) else 0.0
    return PoseEvidence(
        count_inliers(object_map, agree),
        strays,
        view.mask_weight,
        view.mask is not None,
        object_map.pointless,
        has_texture([one.strength for one in object_map.keyframes if math.isfinite(one.strength)]),
        None if object_map.free_axis is None else object_map.free_axis.direction,
        object_map.lead,
    )


def candidate_cost(fit: PoseFit, weights: PoseWeights, mask_weight: float, agreed: int) -> float:
    """The cost by which pose candidates are compared: a pose's cost, less a reward for ``agreed`` inliers."""
    return render_cost(fit, weights, mask_weight) - _INLIER_REWARD * min(agreed, _MAX_REWARDED_INLIERS)


def count_inliers(object_map: ObjectMap, points: FollowedPoints) -> int:
    """How many of the points are landmarks that at least two keyframes have seen."""
    return int((object_map.sightings[points.landmark] >= 2).sum())


def _matched_points(
    object_map: ObjectMap, surface: Surface, view: Keyframe, points: FollowedPoints
) -> MatchedPoints:
    position = object_map.landmarks[points.landmark]
    sound = np.isfinite(position).all(1)
    # A landmark seen once lies on the estimated surface: it is no independent evidence if there are others.
    mature = sound & (object_map.sightings[points.landmark] >= 2)
    if mature.sum() >= ENOUGH_MATURE:
        sound = mature
    return MatchedPoints(
        torch.from_numpy(position[sound]).to(surface.vertices),
        torch.from_numpy(to_window(view, points.pixel[sound])).to(surface.vertices),
    )


# The pose of one frame by landmarks that are followed densely from the nearest keyframes.
#
# A pose that was fitted to pixels and outlines takes over what the surface and the mask are wrong by. Patches of the
# keyframes, warped through the surface, do not.

_NEAREST = 2
"""Keyframes that are looked at; with four of them poses were no better."""
_MIN_AGREEING, _MIN_SHARE = 20, 0.7
"""Landmarks that have to agree with a pose, and their share of all that begin in those keyframes."""
_MAX_TURN = math.radians(2.5)
"""By which a pose is corrected at most. On cube_in_hand, where a new side turns into view and the surface is wrong, the
landmarks of the side before moved poses by 3 to 18 degrees, and were wrong."""


def resect_pose(object_map: ObjectMap, camera: Camera, view: Keyframe, pose: Pose) -> Pose:
    """A frame's pose, corrected by dense landmarks; as it is if too few of them agree."""
    drawn = draw_keyframe(object_map, camera, view, pose)
    if drawn is None:
        return pose
    near = {other.index for other in nearest_views(object_map.keyframes, pose, _NEAREST)}
    positions = [place for place, other in enumerate(object_map.keyframes) if other.index in near]
    scene = draw_keyframes(object_map, camera, positions)
    known = [position for position in positions if scene.views[position] is not None]
    T, share = resect(scene, drawn, known, turns=1)
    begun = sum(len(scene.seeds_of(position)[2]) for position in known)
    if share < _MIN_SHARE or share * begun < _MIN_AGREEING:
        return pose
    corrected = pose_from_arrays(T[:3, :3], T[:3, 3], object_map.vertices)
    turn = float(rotation_angle(corrected.quaternion, pose.quaternion))
    return corrected if turn < _MAX_TURN else pose


_BRIEF, _NEAR = 5, 30.0
"""Lost frames, and degrees, within which the motion model supports a side that was never seen, as a card's edge."""


def pose_predictions(state: Mapped, index: int, mask: NDArray[np.bool_] | None) -> dict[str, Pose]:
    """Predicted poses for frame ``index`` by name, the likeliest first; ``mask`` ``(H, W)`` places a lost object."""
    last, last_index = state.last_pose
    if state.lost and state.trajectory:
        starts = {
            "motion_model": extrapolate_motion(state.trajectory, index),
            "last": state.trajectory[-1][0],
        }
        if mask is not None:
            starts |= {
                f"{name} in the mask": align_to_mask(pose, state.camera, mask)
                for name, pose in starts.items()
            }
            if state.last_candidate is not None:
                starts["last_candidate"] = align_to_mask(state.last_candidate, state.camera, mask)
        return starts
    if state.previous_pose is None:
        return {"last": last}
    before, before_index = state.previous_pose
    steps = (index - last_index) / max(last_index - before_index, 1)
    return {"velocity": extrapolate(before, last, min(steps, 3.0)), "last": last}


def follow_points(state: Mapped, frame: Frame) -> tuple[Pose, FollowedPoints]:
    """The likeliest pose in the next frame, and the tracked points, searched for where they would be then."""
    for image, likeliest, found in state.followed:
        if image is frame.image:
            return likeliest, found
    likeliest = next(iter(pose_predictions(state, frame.index, None).values()))
    points, last, guess = state.tracked_points, state.last_pose[0], None
    if len(points):
        position = state.object_map.landmarks[points.landmark]
        there, here = (project_points(position, pose, state.camera) for pose in (likeliest, last))
        guess = np.asarray(points.pixel + np.nan_to_num(there - here), dtype=np.float32)
    found = follow(state.grey, grey(frame.image), points, guess)
    state.followed[:] = [(frame.image, likeliest, found)]
    return likeliest, found


def is_consistent_with_motion(state: Mapped, pose: Pose, index: int) -> bool:
    """Whether a pose agrees with the motion before a loss: only for a short loss, and near the extrapolated pose."""
    if not state.trajectory or index - state.trajectory[-1][1] > _BRIEF + 1:
        return False
    away = float(rotation_angle(extrapolate_motion(state.trajectory, index).quaternion, pose.quaternion))
    return math.degrees(away) < _NEAR


def advance(state: Mapped, found: PoseCandidate, pose: Pose, grey: NDArray[np.uint8]) -> Mapped:
    """The state after a grey frame ``(H, W)``, with the counts of lost and doubtful frames updated."""
    searched_for = state.lost_frames + 1 if found.view.mask is not None else max(state.lost_frames, 1)
    return replace(
        state,
        last_pose=(pose, found.view.index),
        previous_pose=state.last_pose,
        grey=grey,
        tracked_points=found.points,
        lost_frames=found.lost * searched_for,
        doubtful_frames=found.doubtful * (state.doubtful_frames + 1),
        last_candidate=found.fit.pose if found.lost and found.view.mask is not None else None,
    )


def extend_trajectory(state: Mapped, pose: Pose, index: int) -> Mapped:
    """The state with one more tracked frame for the motion model."""
    return replace(state, trajectory=(*state.trajectory, (pose, index))[-TRAJECTORY_LENGTH:])


TRAJECTORY_LENGTH = 5
"""Tracked frames that are extrapolated from."""
_MAX_EXTRAPOLATION = 12  # frames


def extrapolate_motion(trail: tuple[tuple[Pose, int], ...], index: int) -> Pose:
    """The pose of an object that is not seen: its motion is extrapolated for at most `_MAX_EXTRAPOLATION` frames.

    Args:
        trail: Reliable poses and their frame indices, in order of time; at least one.
        index: The frame's index.
    """
    (first, begin), (last, end) = trail[0], trail[-1]
    if begin == end:
        return last
    return extrapolate(first, last, min(index - end, _MAX_EXTRAPOLATION) / (end - begin))


def align_to_mask(pose: Pose, camera: Camera, mask: NDArray[np.bool_]) -> Pose:
    """A pose shifted parallel to the image plane, so that the object's centre projects into a mask ``(H, W)``."""
    x1, y1 = np.argwhere(mask)[:, ::-1].mean(0)
    x, y, z = pose.translation.tolist()
    shift = [(x1 - camera.cx) / camera.fx * z - x, (y1 - camera.cy) / camera.fy * z - y, 0.0]
    return Pose(pose.translation + pose.translation.new_tensor(shift), pose.quaternion)
