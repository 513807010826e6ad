"""The start: shape and poses of the first frames together, from the points that were followed through them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from tracking3d.estimation.observation import halved
from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.bundle import Structure
from tracking3d.estimation.online.mapping import (
    fit_shape,
    pose_arrays,
    pose_of,
    refine_map,
    surface_places,
    tracks_of,
)
from tracking3d.estimation.online.pose_refinement import PoseWeights, refine_pose
from tracking3d.estimation.online.structure import structure_hypotheses
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.estimation.online.turning import improved, turning_hypotheses
from tracking3d.estimation.start import RADIUS
from tracking3d.geometry.camera import Camera

_VIEWS = 8


@dataclass(frozen=True, eq=False)
class Start:
    """A solved start.

    Attributes:
        known: The map, whose keyframes are the chosen views.
        cost: How badly it re-renders the views.
        bundle: How badly its points fit their tracks.
        origin: Which hypothesis it came from.
    """

    known: ObjectMap
    cost: float
    bundle: float
    origin: str


def solve_start(
    known: ObjectMap, camera: Camera, views: list[View], weights: FitWeights, prior: float, verbose: bool = False
) -> list[Start]:
    """Starts by rising cost; empty where the points cannot tell.

    Args:
        known: Prototype and landmarks; its keyframes are not looked at.
        camera: Of the full frame.
        views: The first frames, the first one's pose is kept.
        weights: Of the shape's terms.
        prior: See `refine_map`.
    """
    chosen = [views[i] for i in sorted(set(np.linspace(0, len(views) - 1, _VIEWS).round().astype(int).tolist()))]
    seen = np.concatenate([view.points.landmark for view in chosen])
    names, counts = np.unique(seen, return_counts=True)
    names = names[(counts >= min(3, len(chosen))) & ~known.candidate[names]]
    if len(names) < 8:
        return by_turning(known, camera, chosen, weights, verbose)
    tracks = tracks_of(chosen, names)
    _, t0 = pose_arrays(chosen[0].pose)
    starts = []
    for structure in structure_hypotheses(tracks, camera.K, t0, RADIUS):
        hypothesis = _with_structure(known, chosen, names, structure)
        hypothesis = fit_shape(hypothesis, list(range(len(chosen))), weights, 4)
        surface = hypothesis.surface()
        fits = [
            refine_pose(surface, view.observation, view.pose, None, PoseWeights(), iterations=(0, 0))
            for view in hypothesis.keyframes
        ]
        cost = float(np.mean([fit.cost for fit in fits])) + structure.cost
        if verbose:
            print(
                f"   {structure.origin:12s} ba {structure.cost:.4f} cost {cost:.4f} app {np.mean([f.appearance for f in fits]):.3f} outline {np.mean([f.outline for f in fits]):.3f}"
            )
        starts.append(Start(hypothesis, cost, structure.cost, structure.origin))
    starts.sort(key=lambda start: start.cost)
    return starts


def with_observations(known: ObjectMap, views: list[View], coarse: bool) -> ObjectMap:
    """The map with its views as they are, or at half the resolution."""
    keyframes = [
        replace(posed, observation=halved(view.observation) if coarse else view.observation, texture=None)
        for posed, view in zip(known.keyframes, views, strict=True)
    ]
    return replace(known, keyframes=tuple(keyframes))


def by_turning(
    known: ObjectMap, camera: Camera, views: list[View], weights: FitWeights, verbose: bool = False
) -> list[Start]:
    """Starts that need no points, by rising cost."""
    maps = [
        (name, replace(known, keyframes=tuple(replace(v, pose=p, texture=None) for v, p in zip(views, poses, strict=True))))
        for name, poses in turning_hypotheses(views, camera)
    ]
    starts: list[Start] = []
    for survivors, rounds, coarse in ((len(maps), 2, True), (6, 4, True), (3, 4, False)):
        starts = []
        for name, candidate in maps[:survivors]:
            tried = with_observations(candidate, views, coarse)
            better, cost = improved(tried, weights, rounds, (3,))
            starts.append(Start(with_observations(better, views, False), cost, 0.0, name))
        starts.sort(key=lambda start: start.cost)
        maps = [(start.origin, start.known) for start in starts]
        if verbose:
            print("   ", [(start.origin, round(start.cost, 4)) for start in starts[:6]])
    return starts


def _with_structure(known: ObjectMap, views: list[View], names: np.ndarray, structure: Structure) -> ObjectMap:
    """The prototype with a structure's poses and points."""
    landmarks = known.landmarks.copy()
    sound = np.isfinite(structure.points).all(1)
    landmarks[names[sound]] = structure.points[sound]
    posed = tuple(
        replace(view, pose=pose_of(structure.R[n], structure.t[n], known.vertices), texture=None)
        for n, view in enumerate(views)
    )
    return replace(known, landmarks=landmarks, keyframes=posed)
