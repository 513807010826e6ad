"""The initial map: shape and poses of the first frames, from the points tracked through them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
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
from tracking3d.estimation.shape import RADIUS, place_on_mask
from tracking3d.frames import mask_iou_or_none
from tracking3d.geometry.alignment import rotation_alignment
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import (
    Pose,
    from_matrix,
    pose_arrays,
    pose_from_arrays,
    rotation_about,
    rotation_angle,
)
from tracking3d.points.bundle_adjustment.adjustment import Structure
from tracking3d.rendering import project, rasterize

_VIEWS = 8
_ROTATION_FRAMES = 12  # after the first, for a start without points: mostly a rotation of 30 to 60 degrees
_ROTATION_VIEWS = 7
_MIN_ROTATION_VIEWS = 4
_FOCAL_LENGTH_PENALTY = 0.1  # share of the cost added to a map with twice or half the assumed focal length
# Structures of several focal lengths whose shape is fitted: the most of them, and their largest cost
_MAX_STRUCTURES, _MAX_BUNDLE_RATIO = 6, 2.0
_FIRST_EVALUATIONS = 5  # of each hypothesis, at half resolution
_VARIED, _SURVIVORS = 4, 5  # hypotheses that are varied, and that are fitted further (measured)
# Evaluations, whether at half resolution, and how many survivors take part (measured: with five the same winners)
_STAGES = ((8, True, 5), (5, False, 3))
_LAST_EVALUATIONS = 5  # of the best one
_VIEWS_AGAIN = 12  # keyframes from which a map is restarted (chosen)
_CLEARLY_BETTER = 0.95  # share of the costs of the present map and the best other rotation (chosen)
_SAME_ROTATION = 10.0  # degrees up to which two hypotheses are one (chosen)
_RIVAL_EVALUATIONS = 12  # of a rotation that a finished map is compared with (as its own fit has)
_LARGEST_LEAD = 2.0  # (chosen)
_TURNS_OTHERWISE = 15.0  # degrees, mean over the views after alignment (chosen among 10, 15 and 20)
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
        replace(posed, observation=view.observation.half if coarse else view.observation, texture=None)
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

    More views tell hypotheses apart that the first views do not. The present rotations compete, the reversed ones,
    those near both, and those that go on from the first views; the shape begins as the prototype. At most
    `_VIEWS_AGAIN` keyframes stay.

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
    poses += continue_rotation(chosen, camera)
    blank = replace(object_map, vertices=object_map.shape.rest, free_axis=None)
    tried = [(math.inf, replace(blank, keyframes=_with_poses(chosen, one)), "") for one in poses]
    (cost, found, _), *rivals = _fit_survivors(fit, fit(tried, _FIRST_EVALUATIONS, True))
    as_it_is = replace(object_map, keyframes=_with_poses(chosen, present), free_axis=None)
    ((before, _, _),) = fit([(math.inf, as_it_is, "")], _LAST_EVALUATIONS, False)
    others = [one for one, rival, _ in rivals if _degrees_apart(rival, found) > _SAME_ROTATION]
    clear = cost < _CLEARLY_BETTER * min([before, *others])
    return _without_points(found) if clear else object_map


def lead_over_rivals(object_map: ObjectMap, camera: Camera, weights: FitWeights) -> float:
    """The logarithm by which fits of other rotations to the keyframes of a map without points cost more than its own.

    The rivals, its reversal and rotations near it, begin with the prototype. The joint cost, with light, tells right
    rotations of a whole video from wrong ones where that of each frame does not.

    Args:
        object_map: The map, fitted to its keyframes.
        camera: The camera of the full frame.
        weights: The weights of the shape's terms.

    Returns:
        That of the cheapest rival that turns otherwise, at most `_LARGEST_LEAD`: so, too, if all end as the map turns.
    """
    modes, views = ShapeBasis.of(object_map.shape), list(object_map.keyframes)
    poses, blank = [view.pose for view in views], replace(object_map, vertices=object_map.shape.rest)
    own, cost = Pose.stack(poses).R.double().numpy(), fit_jointly(object_map, modes, weights, 0)[1]
    others = [_LARGEST_LEAD]
    for rotations in (reverse_rotations(views, camera), *vary_rotations(views, poses, camera)):
        start = replace(blank, keyframes=_with_poses(views, rotations))
        rival, its_cost = fit_jointly(start, modes, weights, _RIVAL_EVALUATIONS)
        R = Pose.stack([view.pose for view in rival.keyframes]).R.double().numpy()
        apart = R @ rotation_alignment(R, own) @ own.transpose(0, 2, 1)
        if Rotation.from_matrix(apart).magnitude().mean() > math.radians(_TURNS_OTHERWISE):
            others.append(math.log(its_cost / cost))
    return min(others)


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
        posed = with_observations(hypothesis, views, coarse)
        found, cost = fit_jointly(posed, modes, weights, evaluations)
        fitted.append((cost + _MISSED * (1 - _mean_overlap(found)), found, name))
    return sorted(fitted, key=lambda one: one[0])


def _mean_overlap(object_map: ObjectMap) -> float:
    """Mean IoU of the silhouettes with the masks, as in `PoseFit`."""
    targets = [view.observation.target for view in object_map.keyframes]
    poses = Pose.stack([view.pose for view in object_map.keyframes])
    K, size = torch.stack([target.K for target in targets]), targets[0].inside.shape
    screen, depth = project(object_map.vertices, poses.R, poses.translation, K)
    drawn = rasterize(screen, depth, object_map.shape.faces, (size[0], size[1]), object_map.renderer)
    pairs = zip(drawn.face_index >= 0, targets, strict=True)
    return float(np.mean([float(target.overlap(covered)) for covered, target in pairs]))


def _fit_survivors(
    fit: Callable[[list[_Fitted], int, bool], list[_Fitted]], tried: list[_Fitted]
) -> list[_Fitted]:
    """The better hypotheses, fitted to the end, by rising cost."""
    tried = _distinct(tried, _SURVIVORS)
    for evaluations, coarse, most in _STAGES:
        tried = fit(tried[:most], evaluations, coarse)
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


TURN = 35.0
"""Degrees of rotation from the first view to the last, in eight directions. Varied, they are 21 to 56 (measured)."""
PROFILES = ((0.0, 1.0), (0.5, 1.0), (0.0, 0.5))
"""Parts of the time in which the object turns: a hand takes a thing before it turns it, or then holds it still."""
DIRECTIONS = 8
_VARIED_EXTENTS = (0.6, 1.6)  # times the rotation (chosen)
_VARIED_AXES = (-22.0, 22.0)  # degrees in the image plane, half of what lies between two directions
_FASTER = (1.0, 1.6)  # times the speed of the first views at which a rotation goes on (chosen)
_OUTLINE_SIDE = 48  # pixels of the pictures in which outlines are compared (chosen)
_VARIED_SPIN = (-0.5, 0.5)  # rotation about the line of sight, as a share of the rest (chosen)


def rotation_hypotheses(views: list[Keyframe], camera: Camera) -> list[tuple[str, list[Pose]]]:
    """Poses of the views for no rotation, and for turning in eight directions all the time, late or early; with names.

    Translations follow the masks' centres and sizes.
    """
    first = views[0].pose
    placed = [_place_views(views[0], view, camera) for view in views]
    found = [("no rotation", [Pose(translation, first.quaternion) for translation in placed])]
    frames = max(views[-1].index - views[0].index, 1)
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = first.translation.new_tensor([math.cos(angle), math.sin(angle), 0.0])
        parts = np.array([view.index - views[0].index for view in views]) / frames
        for begin, end in PROFILES:
            degrees = TURN * np.clip((parts - begin) / (end - begin), 0, 1)
            poses = [
                from_matrix(rotation_about(axis, float(part)) @ first.R, translation)
                for part, translation in zip(degrees, placed, strict=True)
            ]
            found.append((f"rotation {round(math.degrees(angle))}", poses))
    return found


def vary_rotations(views: list[Keyframe], poses: list[Pose], camera: Camera) -> list[list[Pose]]:
    """Poses that turn a little differently from those of a fit: by less or more, about other axes, rolling as well.

    A shape that was fitted with wrong poses holds them where they are. Begun again near by, with the prototype, the
    same fit often ends at a lower cost.

    Args:
        views: The views, as for `rotation_hypotheses`.
        poses: Their poses by a fit, the first one's fixed.
        camera: The camera of the full frame.
    """
    R = torch.stack([pose.R for pose in poses]).double().cpu().numpy()
    steps = Rotation.from_matrix(R[1:] @ R[:-1].transpose(0, 2, 1)).as_rotvec()
    extent = np.linalg.norm(steps, axis=1, keepdims=True)
    varied = [steps * factor for factor in _VARIED_EXTENTS]
    varied += [Rotation.from_euler("z", angle, degrees=True).apply(steps) for angle in _VARIED_AXES]
    varied += [steps + share * extent * np.array([0.0, 0.0, 1.0]) for share in _VARIED_SPIN]
    return [_turn_by_steps(views, one, camera) for one in varied]


def reverse_rotations(views: list[Keyframe], camera: Camera) -> list[Pose]:
    """The views' poses with the other sense of turning: near and far are exchanged, the outlines remain."""
    R = torch.stack([view.pose.R for view in views]).double().cpu().numpy()
    steps = Rotation.from_matrix(R[1:] @ R[:-1].transpose(0, 2, 1)).as_rotvec()
    return _turn_by_steps(views, steps * np.array([-1.0, -1.0, 1.0]), camera)


def continue_rotation(views: list[Keyframe], camera: Camera) -> list[list[Pose]]:
    """Poses that rotate on and on as in the first views, or come back where the outlines do, in both senses.

    A side that turns into view is a guess at first, and tracking it lags behind.
    """
    R = torch.stack([view.pose.R for view in views]).double().cpu().numpy()
    time = np.array([view.index - views[0].index for view in views])
    last = max(int(np.count_nonzero(time <= _ROTATION_FRAMES)) - 1, 1)
    speed = Rotation.from_matrix(R[last] @ R[0].T).as_rotvec() / time[last]
    back = np.where((time[1:] + time[:-1]) / 2 < _turning_time(views), 1.0, -1.0)
    ways = [_FASTER[0] * np.diff(time), _FASTER[1] * np.diff(time), back * np.diff(time)]
    senses = [speed, speed * np.array([-1.0, -1.0, 1.0])]
    return [_turn_by_steps(views, way[:, None] * sense, camera) for sense in senses for way in ways]


def _turning_time(views: list[Keyframe]) -> float:
    """The frames after the first view about which the outlines are most alike when time is mirrored."""
    outlines = []
    for view in views:
        assert view.mask is not None
        y, x = np.nonzero(view.mask)
        scale = _OUTLINE_SIDE / (1.8 * math.sqrt(len(x)))
        place = _OUTLINE_SIDE / 2 - scale * np.array([x.mean(), y.mean()])
        to_outline = np.array([[scale, 0, place[0]], [0, scale, place[1]]])
        mask = cv2.warpAffine(view.mask.astype(np.float32), to_outline, (_OUTLINE_SIDE, _OUTLINE_SIDE))
        outlines.append(mask > 0.5)
    time = np.array([view.index - views[0].index for view in views])

    def difference(turn: float) -> float:
        """Mean 1 - IoU of the outlines with those of the views at the mirrored times."""
        near = np.abs(2 * turn - time[:, None] - time[None]).argmin(1)
        pairs = [(a, b) for a, b in enumerate(near) if 0 <= 2 * turn - time[a] <= time[-1] and a != b]
        alike = [mask_iou_or_none(outlines[a], outlines[b]) or 0.0 for a, b in pairs]
        return 1 - float(np.mean(alike)) if alike else 1.0

    return min((float(turn) for turn in time[-1] * np.linspace(0.25, 0.75, 11)), key=difference)


def _turn_by_steps(views: list[Keyframe], steps: NDArray[np.float64], camera: Camera) -> list[Pose]:
    """Poses that turn from view to view by rotation vectors ``(V - 1, 3)`` in camera axes, placed on the masks."""
    first = views[0].pose
    rotation, found = Rotation.identity(), [first]
    for view, step in zip(views[1:], steps, strict=True):
        rotation = Rotation.from_rotvec(step) * rotation
        turned = first.R.new_tensor(rotation.as_matrix()) @ first.R
        found.append(from_matrix(turned, _place_views(views[0], view, camera)))
    return found


def _place_views(first: Keyframe, view: Keyframe, camera: Camera) -> torch.Tensor:
    """The first translation moved so that it projects to a view's mask."""
    if first.mask is None or view.mask is None or not (first.mask.any() and view.mask.any()):
        return first.pose.translation
    one, other = (cv2.moments(mask.view(np.uint8), binaryImage=True) for mask in (first.mask, view.mask))
    x0, y0, x1, y1 = (moments[part] / moments["m00"] for moments in (one, other) for part in ("m10", "m01"))
    ratio = float(np.clip(math.sqrt(one["m00"] / other["m00"]), 0.5, 2.0))
    depth = float(first.pose.translation[2])
    shift = first.pose.translation.new_tensor(
        [(x1 - x0) / camera.fx * depth, (y1 - y0) / camera.fy * depth, 0.0]
    )
    return (first.pose.translation + shift) * ratio
