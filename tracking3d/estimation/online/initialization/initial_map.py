"""The initial map: shape and poses of the first frames, from the points tracked through them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tracking3d.bundle_adjustment.adjustment import Structure
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import downsample
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.initialization.rotation_hypotheses import (
    reverse_rotations,
    rotation_hypotheses,
    vary_rotations,
)
from tracking3d.estimation.online.initialization.structure_from_motion import structure_hypotheses
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.global_refinement import fit_keyframes
from tracking3d.estimation.online.mapping.local_mapping import fit_shape, tracks_of
from tracking3d.estimation.online.mapping.photometric_adjustment import fit_jointly
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.prototype_start import RADIUS, place_on_mask
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays, rotation_angle

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
_FIRST_EVALUATIONS = 5  # of each hypothesis, at half resolution
_VARIED, _SURVIVORS = 4, 5  # hypotheses that are varied, and that are fitted to the end (measured)
_STAGES = ((8, True), (5, False))  # evaluations of the survivors, and whether at half resolution
_LAST_EVALUATIONS = 5  # of the best one
_VIEWS_AGAIN = 12  # keyframes from which a map is restarted (chosen)
_CLEARLY_BETTER = 0.95  # share of the costs of the present map and the best other rotation (chosen)
_SAME_ROTATION = 10.0  # degrees up to which two hypotheses are one (chosen)
_MISSED = 0.3  # cost of masks that are missed wholly (chosen)


@dataclass(frozen=True, eq=False)
class InitialMap:
    """One hypothesis of the initialization."""

    object_map: ObjectMap  # the map; its keyframes are the selected views
    cost: float  # cost of re-rendering the views, increased if the focal length is far from the assumed one
    bundle: float  # cost of the points' reprojection
    origin: str  # the hypothesis that it came from
    camera: Camera  # the camera that it was estimated with
    overlap: float = 1.0  # mean IoU of the silhouettes with the masks


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


def with_contrast(view: Keyframe, space: FeatureSpace) -> Keyframe:
    """A view with the contrast among its features, if the space has it."""
    seen = view.observation
    features = space.add_contrast(seen.features, seen.image)
    return view if features is seen.features else replace(view, observation=replace(seen, features=features))


def initialize_without_points(
    object_map: ObjectMap, camera: Camera, views: list[Keyframe], weights: FitWeights
) -> list[InitialMap]:
    """The best initial map by pixels and outlines alone, from the first views.

    Shape and poses are fitted together from every hypothesis of `rotation_hypotheses`, and again from rotations near
    the best of them, see `vary_rotations`; the better ones continue.

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
    fit = partial(_fit_hypotheses, ShapeBasis.of(object_map.shape), weights, chosen)

    def posed(name: str, poses: list[Pose]) -> _Fitted:
        return math.inf, replace(object_map, keyframes=_with_poses(chosen, poses)), name

    tried = fit([posed(*one) for one in rotation_hypotheses(chosen, camera)], _FIRST_EVALUATIONS, True)
    tried = _distinct(tried, _VARIED)
    varied = [
        posed(name, poses)
        for _, found, name in tried
        for poses in vary_rotations(chosen, [view.pose for view in found.keyframes], camera)
    ]
    best, *_ = _fit_survivors(fit, [*tried, *fit(varied, _FIRST_EVALUATIONS, True)])
    ((_, found, name),) = fit([best], _LAST_EVALUATIONS, False)
    found = _without_points(found)
    fits = fit_keyframes(found)
    cost, overlap = (float(np.mean([getattr(one, part) for one in fits])) for part in ("cost", "overlap"))
    return [InitialMap(found, cost, 0.0, name, camera, overlap)]


def restart_without_points(object_map: ObjectMap, camera: Camera, weights: FitWeights) -> ObjectMap:
    """A map without points from the same keyframes, restarted with other rotations, if it explains them better.

    More views tell hypotheses apart that the first views do not. The present rotations compete, the reversed ones, and
    those near both; the shape begins as the prototype. At most `_VIEWS_AGAIN` keyframes stay.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        weights: The weights of the shape's terms.
    """
    chosen = _spread_views([view for view in object_map.keyframes if view.mask is not None], _VIEWS_AGAIN)
    if len(chosen) < _MIN_ROTATION_VIEWS:
        return object_map
    fit = partial(_fit_hypotheses, ShapeBasis.of(object_map.shape), weights, chosen)
    present = [view.pose for view in chosen]
    reverse = reverse_rotations(chosen, camera)
    poses = [present, reverse]
    poses += [one for other in (present, reverse) for one in vary_rotations(chosen, other, camera)]
    blank = replace(object_map, vertices=object_map.shape.rest, free_axis=None)
    tried = [(math.inf, replace(blank, keyframes=_with_poses(chosen, one)), "") for one in poses]
    (cost, found, _), *rivals = _fit_survivors(fit, fit(tried, _FIRST_EVALUATIONS, True))
    as_it_is = replace(object_map, keyframes=_with_poses(chosen, present), free_axis=None)
    ((before, _, _),) = fit([(math.inf, as_it_is, "")], _LAST_EVALUATIONS, False)
    others = [one for one, rival, _ in rivals if _degrees_apart(rival, found) > _SAME_ROTATION]
    clear = cost < _CLEARLY_BETTER * min([before, *others])
    return _without_points(found) if clear else object_map


_Fitted = tuple[float, ObjectMap, str]


def _fit_hypotheses(
    modes: ShapeBasis,
    weights: FitWeights,
    views: list[Keyframe],
    tried: list[_Fitted],
    evaluations: int,
    coarse: bool,
) -> list[_Fitted]:
    """Shape and poses of each hypothesis fitted to the views a little further, by rising cost."""
    fitted = []
    for _, hypothesis, name in tried:
        found, cost = fit_jointly(with_observations(hypothesis, views, coarse), modes, weights, evaluations)
        missed = 1 - float(np.mean([fit.overlap for fit in fit_keyframes(found)]))
        fitted.append((cost + _MISSED * missed, found, name))
    return sorted(fitted, key=lambda one: one[0])


def _fit_survivors(
    fit: Callable[[list[_Fitted], int, bool], list[_Fitted]], tried: list[_Fitted]
) -> list[_Fitted]:
    """The better hypotheses, fitted to the end, by rising cost."""
    tried = _distinct(tried, _SURVIVORS)
    for evaluations, coarse in _STAGES:
        tried = fit(tried, evaluations, coarse)
    return tried


def _distinct(fitted: list[_Fitted], most: int) -> list[_Fitted]:
    """The best hypotheses of which no two turn alike from the first view to the last."""
    found: list[_Fitted] = []
    for one in sorted(fitted, key=lambda one: one[0]):
        if all(_degrees_apart(one[1], other[1]) > _SAME_ROTATION for other in found):
            found.append(one)
    return found[:most]


def _degrees_apart(one: ObjectMap, other: ObjectMap) -> float:
    """How far two maps of the same views differ in the last view's rotation; the first one's is the same."""
    last, there = one.keyframes[-1].pose, other.keyframes[-1].pose
    return math.degrees(float(rotation_angle(last.quaternion, there.quaternion)))


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
