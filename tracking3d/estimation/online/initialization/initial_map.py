"""The initial map: shape and poses of the first frames, from the points tracked through them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tracking3d.bundle_adjustment.adjustment import Structure
from tracking3d.estimation.observation import downsample
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.initialization.rotation_hypotheses import rotation_hypotheses
from tracking3d.estimation.online.initialization.structure_from_motion import structure_hypotheses
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.local_mapping import fit_shape, tracks_of
from tracking3d.estimation.online.mapping.photometric_adjustment import fit_jointly
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.prototype_start import RADIUS, place_on_mask
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays

_VIEWS = 8
_ROTATION_FRAMES = (
    12  # frames after the first for an initialization without points: mostly a rotation of 30 to 60 degrees
)
_ROTATION_VIEWS = 7
_MIN_ROTATION_VIEWS = 4
_FOCAL_LENGTH_PENALTY = 0.1  # share of the cost added to a map with twice or half the assumed focal length
_MAX_STRUCTURES, _MAX_BUNDLE_RATIO = (
    6,
    2.0,
)  # structures of several focal lengths whose shape is fitted: the most of them, and their largest cost
# Stages: hypotheses that continue, evaluations, half resolution.
_STAGES = ((99, 5, True), (5, 12, True), (3, 10, False))


@dataclass(frozen=True, eq=False)
class InitialMap:
    """One hypothesis of the initialization.

    Attributes:
        object_map: The map; its keyframes are the selected views.
        cost: Cost of re-rendering the views, increased if the focal length is far from the assumed one.
        bundle: Cost of the points' reprojection.
        origin: The hypothesis that it came from.
        camera: The camera that it was estimated with.
    """

    object_map: ObjectMap
    cost: float
    bundle: float
    origin: str
    camera: Camera


def solve_start(
    object_map: ObjectMap,
    cameras: Sequence[Camera],
    views: list[Keyframe],
    weights: FitWeights,
    prior: float,
) -> list[InitialMap]:
    """Initial maps by rising cost; empty if the points do not constrain any.

    Args:
        object_map: Prototype and landmarks; its keyframes are not used.
        cameras: Cameras of the full frame: that of the views first, then others with possible focal lengths.
        views: The first frames; the first one's pose is fixed.
        weights: The weights of the shape's terms.
        prior: See `refine_map`.
    """
    chosen = [
        views[i] for i in sorted(set(np.linspace(0, len(views) - 1, _VIEWS).round().astype(int).tolist()))
    ]
    seen = np.concatenate([view.points.landmark for view in chosen])
    names, counts = np.unique(seen, return_counts=True)
    names = names[(counts >= min(3, len(chosen))) & ~object_map.candidate[names]]
    if len(names) < 8:
        return initialize_without_points(object_map, cameras[0], views, weights)
    tracks = tracks_of(chosen, names)
    solved = []
    for camera in cameras:
        posed = [with_focal_length(view, cameras[0], camera) for view in chosen]
        _, t0 = pose_arrays(posed[0].pose)
        structures = structure_hypotheses(tracks, camera.K, t0, RADIUS)
        solved += [(structure, camera, posed) for structure in structures]
    starts = []
    for structure, camera, posed in _likely_structures(solved) if len(cameras) > 1 else solved:
        hypothesis = _with_structure(object_map, posed, names, structure)
        hypothesis = fit_shape(hypothesis, list(range(len(posed))), weights, 4)
        surface = hypothesis.surface()
        fits = [
            refine_pose(surface, view.observation, view.pose, None, PoseWeights(), iterations=(0, 0))
            for view in hypothesis.keyframes
        ]
        cost = float(np.mean([fit.cost for fit in fits])) + structure.cost
        cost *= 1 + _FOCAL_LENGTH_PENALTY * abs(math.log2(camera.fy / cameras[0].fy))
        starts.append(InitialMap(hypothesis, cost, structure.cost, structure.origin, camera))
    starts.sort(key=lambda start: start.cost)
    return starts


_Solved = tuple[Structure, Camera, list[Keyframe]]


def _likely_structures(solved: list[_Solved]) -> list[_Solved]:
    """The structures whose points fit best; a wrong focal length distorts the points by more than the noise."""
    solved = sorted(solved, key=lambda one: one[0].cost)
    return [one for one in solved if one[0].cost < _MAX_BUNDLE_RATIO * solved[0][0].cost][:_MAX_STRUCTURES]


def with_observations(object_map: ObjectMap, views: list[Keyframe], coarse: bool) -> ObjectMap:
    """The map with its views at full or half resolution."""
    keyframes = [
        replace(posed, observation=downsample(view.observation) if coarse else view.observation, texture=None)
        for posed, view in zip(object_map.keyframes, views, strict=True)
    ]
    return replace(object_map, keyframes=tuple(keyframes))


def initialize_without_points(
    object_map: ObjectMap, camera: Camera, views: list[Keyframe], weights: FitWeights
) -> list[InitialMap]:
    """The best initial map by pixels and outlines alone, from the first views.

    Shape and poses are fitted together from every hypothesis of `rotation_hypotheses`; the better ones continue.

    Args:
        object_map: Prototype and landmarks; its keyframes are not used.
        camera: The camera of the full frame.
        views: All first frames with masks; the first `_ROTATION_FRAMES` are used.
        weights: The weights of the shape's terms.
    """
    near = [view for view in views if view.index - views[0].index <= _ROTATION_FRAMES]
    chosen = _spread_views(near if len(near) >= _MIN_ROTATION_VIEWS else views, _ROTATION_VIEWS)
    if (mask := chosen[0].mask) is not None and mask.any():  # the object may have moved since the first frame
        chosen[0] = replace(chosen[0], pose=place_on_mask(object_map.shape.rest, camera, mask))
    modes = ShapeBasis.of(object_map.shape)
    tried = [
        (math.inf, name, replace(object_map, keyframes=_with_poses(chosen, poses)))
        for name, poses in rotation_hypotheses(chosen, camera)
    ]
    for survivors, iterations, coarse in _STAGES:
        better = []
        for _, name, candidate in tried[:survivors]:
            fitted, cost = fit_jointly(
                with_observations(candidate, chosen, coarse), modes, weights, iterations
            )
            better.append((cost, name, fitted))
        tried = sorted(better, key=lambda one: one[0])
    _, name, found = tried[0]
    found = _without_points(found)
    surface = found.surface()
    fits = [
        refine_pose(surface, view.observation, view.pose, None, PoseWeights(), iterations=(0,))
        for view in found.keyframes
    ]
    return [InitialMap(found, float(np.mean([fit.cost for fit in fits])), 0.0, name, camera)]


def _spread_views(views: list[Keyframe], most: int) -> list[Keyframe]:
    """At most ``most`` of the views, evenly spaced."""
    places = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
    return [views[place] for place in sorted(set(places.tolist()))]


def _with_poses(views: list[Keyframe], poses: list[Pose]) -> tuple[Keyframe, ...]:
    """The views as keyframes with these poses."""
    return tuple(replace(view, pose=pose, texture=None) for view, pose in zip(views, poses, strict=True))


def _without_points(object_map: ObjectMap) -> ObjectMap:
    """The map without its keyframes' landmark observations: those points did not move with the object."""
    nothing = np.zeros(0, np.int64)
    keyframes = tuple(
        replace(
            view,
            points=FollowedPoints.none(),
            keypoints=Keypoints.none(),
            keypoint_landmark=nothing,
            mask_weight=1.0,
        )
        for view in object_map.keyframes
    )
    return replace(
        object_map,
        landmarks=np.zeros((0, 3)),
        candidate=np.zeros(0, bool),
        keyframes=keyframes,
        pointless=True,
    )


def _with_structure(
    object_map: ObjectMap, views: list[Keyframe], names: np.ndarray, structure: Structure
) -> ObjectMap:
    """The prototype with a structure's poses and points."""
    landmarks = object_map.landmarks.copy()
    sound = np.isfinite(structure.points).all(1)
    landmarks[names[sound]] = structure.points[sound]
    posed = tuple(
        replace(
            view, pose=pose_from_arrays(structure.R[n], structure.t[n], object_map.vertices), texture=None
        )
        for n, view in enumerate(views)
    )
    return replace(object_map, landmarks=landmarks, keyframes=posed)
