"""A frame's way into the map: its points become landmarks, and the map is refined with it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.joint_fit import refine_without_points
from tracking3d.estimation.online.keeping import compacted, thinned
from tracking3d.estimation.online.keypoints import detect
from tracking3d.estimation.online.mapping import refine_map, window_of, with_landmarks
from tracking3d.estimation.online.points import MOST_FOLLOWED, MOST_POINTS, FollowedPoints, new_corners
from tracking3d.estimation.online.recruits import recruit, with_candidates
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.geometry.camera import Camera

_MOST_WITHOUT_POINTS = 15


def with_points(
    known: ObjectMap, camera: Camera, view: View, image: NDArray[np.uint8]
) -> tuple[ObjectMap, View]:
    """With landmarks at a view's keypoints and corners, and candidates beside its mask.

    Args:
        known: The map.
        camera: Of the full frame.
        view: With its pose and the points that were followed into it.
        image: ``(H, W)`` grey.
    """
    if known.pointless:
        return known, view
    inside = view.mask if view.mask is not None else known.silhouette(view.pose, camera)
    keypoints = detect(image, inside)
    taken = np.concatenate([view.points.pixel, keypoints.pixel])
    corners = new_corners(image, inside, taken, MOST_POINTS)
    known, view = with_landmarks(known, camera, view, keypoints, corners)
    return (known, view) if known.held else with_candidates(known, view, image)


def with_keyframe(
    known: ObjectMap, camera: Camera, view: View, image: NDArray[np.uint8], config: OnlineConfig
) -> tuple[ObjectMap, FollowedPoints]:
    """The map with a view as a new keyframe, refined over a window; and the points to follow from it."""
    known, view = with_points(known, camera, view, image)
    drawn, filmed = known.keyframes[: known.held], (*known.keyframes[known.held :], view)
    known = replace(known, keyframes=(*drawn, *thinned(filmed, config.most_keyframes)))
    window = window_of(len(known.keyframes), config.window)
    known = refined(known, camera, window, config, bundle_iterations=10, rounds=1)
    followed = known.keyframes[-1].points.spread(MOST_FOLLOWED, float(view.observation.window.side))
    return compacted(known, followed)


def refined(
    known: ObjectMap,
    camera: Camera,
    positions: list[int],
    config: OnlineConfig,
    *,
    bundle_iterations: int,
    rounds: int,
) -> ObjectMap:
    """Candidates taken over or dropped, then poses, landmarks and shape refined; see `refine_map`.

    Of an object whose shape is held nothing is, but what the newest view shows of its texture is taken.
    """
    if known.held:
        newest = known.keyframes[-1]
        newest = replace(newest, texture=known.back_project(newest.observation.features, newest))
        return replace(known, keyframes=(*known.keyframes[:-1], newest))
    if known.pointless:
        recent = list(range(len(known.keyframes)))[-_MOST_WITHOUT_POINTS:]
        return refine_without_points(known, sorted({0, *recent}), FitWeights(smoothness=config.smoothness))
    known = recruit(known, camera, positions)
    return refine_map(
        known,
        camera,
        positions,
        weights=FitWeights(smoothness=config.smoothness),
        prior=config.surface_prior,
        bundle_iterations=bundle_iterations,
        rounds=rounds,
    )
