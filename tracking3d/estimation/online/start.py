"""The start: shape and poses of the first frames together, from the points that were followed through them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tracking3d.bundle_adjustment.adjustment import Structure
from tracking3d.estimation.observation import halved
from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.joint_fit import fit_jointly
from tracking3d.estimation.online.keypoints import Keypoints
from tracking3d.estimation.online.lens import through
from tracking3d.estimation.online.mapping import (
    fit_shape,
    pose_arrays,
    pose_of,
    tracks_of,
)
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.pose_refinement import refine_pose
from tracking3d.estimation.online.pose_refinement_types import PoseWeights
from tracking3d.estimation.online.shape_modes import Modes
from tracking3d.estimation.online.structure import structure_hypotheses
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.estimation.online.turning import turning_hypotheses
from tracking3d.estimation.start import RADIUS
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose

_VIEWS = 8
_TURNING_FRAMES = 12  # after the first, for a start without points: a turn of 30 to 60 degrees, mostly
_TURNING_VIEWS = 7
_FEWEST_TURNING = 4
_UNUSUAL_LENS = (
    0.1  # of its cost, what a start is charged for a lens twice as long or short as the assumed one
)
_MOST_LIKELY, _AS_LIKELY = (
    6,
    2.0,
)  # structures under several lenses whose shape is fitted: how many, and how costly
# Hypotheses that go on, evaluations, half resolution.
_STAGES = ((99, 5, True), (5, 12, True), (3, 10, False))


@dataclass(frozen=True, eq=False)
class InitialMap:
    """A solved start.

    Attributes:
        known: The map, whose keyframes are the chosen views.
        cost: How badly it re-renders the views; more for a lens that is far from the assumed one.
        bundle: How badly its points fit their tracks.
        origin: Which hypothesis it came from.
        camera: The camera that it was solved with.
    """

    known: ObjectMap
    cost: float
    bundle: float
    origin: str
    camera: Camera


def solve_start(
    known: ObjectMap,
    cameras: Sequence[Camera],
    views: list[View],
    weights: FitWeights,
    prior: float,
) -> list[InitialMap]:
    """Starts by rising cost; empty where the points cannot tell.

    Args:
        known: Prototype and landmarks; its keyframes are not looked at.
        cameras: Of the full frame: the one that the views are of, and other lenses that it might have had.
        views: The first frames, the first one's pose is kept.
        weights: Of the shape's terms.
        prior: See `refine_map`.
    """
    chosen = [
        views[i] for i in sorted(set(np.linspace(0, len(views) - 1, _VIEWS).round().astype(int).tolist()))
    ]
    seen = np.concatenate([view.points.landmark for view in chosen])
    names, counts = np.unique(seen, return_counts=True)
    names = names[(counts >= min(3, len(chosen))) & ~known.candidate[names]]
    if len(names) < 8:
        return by_turning(known, cameras[0], views, weights)
    tracks = tracks_of(chosen, names)
    solved = []
    for camera in cameras:
        posed = [through(view, cameras[0], camera) for view in chosen]
        _, t0 = pose_arrays(posed[0].pose)
        structures = structure_hypotheses(tracks, camera.K, t0, RADIUS)
        solved += [(structure, camera, posed) for structure in structures]
    starts = []
    for structure, camera, posed in _likely(solved) if len(cameras) > 1 else solved:
        hypothesis = _with_structure(known, posed, names, structure)
        hypothesis = fit_shape(hypothesis, list(range(len(posed))), weights, 4)
        surface = hypothesis.surface()
        fits = [
            refine_pose(surface, view.observation, view.pose, None, PoseWeights(), iterations=(0, 0))
            for view in hypothesis.keyframes
        ]
        cost = float(np.mean([fit.cost for fit in fits])) + structure.cost
        cost *= 1 + _UNUSUAL_LENS * abs(math.log2(camera.fy / cameras[0].fy))
        starts.append(InitialMap(hypothesis, cost, structure.cost, structure.origin, camera))
    starts.sort(key=lambda start: start.cost)
    return starts


_Solved = tuple[Structure, Camera, list[View]]


def _likely(solved: list[_Solved]) -> list[_Solved]:
    """Those whose points fit best; a wrong lens bends the points more than the noise does."""
    solved = sorted(solved, key=lambda one: one[0].cost)
    return [one for one in solved if one[0].cost < _AS_LIKELY * solved[0][0].cost][:_MOST_LIKELY]


def with_observations(known: ObjectMap, views: list[View], coarse: bool) -> ObjectMap:
    """The map with its views as they are, or at half the resolution."""
    keyframes = [
        replace(posed, observation=halved(view.observation) if coarse else view.observation, texture=None)
        for posed, view in zip(known.keyframes, views, strict=True)
    ]
    return replace(known, keyframes=tuple(keyframes))


def by_turning(known: ObjectMap, camera: Camera, views: list[View], weights: FitWeights) -> list[InitialMap]:
    """The best start that needs no points, from the first of the views.

    Shape and poses are fitted together from every hypothesis of `turning_hypotheses`; the better ones go on.

    Args:
        known: Prototype and landmarks; its keyframes are not looked at.
        camera: Of the full frame.
        views: The first frames with masks, all of them: the first `_TURNING_FRAMES` are used.
        weights: Of the shape's terms.
    """
    near = [view for view in views if view.index - views[0].index <= _TURNING_FRAMES]
    chosen = _spread(near if len(near) >= _FEWEST_TURNING else views, _TURNING_VIEWS)
    modes = Modes.of(known.shape)
    tried = [
        (math.inf, name, replace(known, keyframes=_posed(chosen, poses)))
        for name, poses in turning_hypotheses(chosen, camera)
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


def _spread(views: list[View], most: int) -> list[View]:
    """At most so many of the views, evenly."""
    places = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
    return [views[place] for place in sorted(set(places.tolist()))]


def _posed(views: list[View], poses: list[Pose]) -> tuple[View, ...]:
    """The views as keyframes with these poses."""
    return tuple(replace(view, pose=pose, texture=None) for view, pose in zip(views, poses, strict=True))


def _without_points(known: ObjectMap) -> ObjectMap:
    """The map without what its keyframes show of the landmarks: they did not move with the object."""
    nothing = np.zeros(0, np.int64)
    keyframes = tuple(
        replace(
            view,
            points=FollowedPoints.none(),
            keypoints=Keypoints.none(),
            keypoint_landmark=nothing,
            mask_weight=1.0,
        )
        for view in known.keyframes
    )
    return replace(
        known, landmarks=np.zeros((0, 3)), candidate=np.zeros(0, bool), keyframes=keyframes, pointless=True
    )


def _with_structure(
    known: ObjectMap, views: list[View], names: np.ndarray, structure: Structure
) -> ObjectMap:
    """The prototype with a structure's poses and points."""
    landmarks = known.landmarks.copy()
    sound = np.isfinite(structure.points).all(1)
    landmarks[names[sound]] = structure.points[sound]
    posed = tuple(
        replace(view, pose=pose_of(structure.R[n], structure.t[n], known.vertices), texture=None)
        for n, view in enumerate(views)
    )
    return replace(known, landmarks=landmarks, keyframes=posed)
