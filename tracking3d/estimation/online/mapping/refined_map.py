"""A map moved to poses and a surface that were refined before, then refined around the keyframes that are new."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.local_mapping import refine_map
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.solver import RefinedStart
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays

_MOST_BENT = 0.25
"""Distance in radii of the object by which the refined surface may lie elsewhere than the map's, as a median: a surface
farther off belongs to another map, or was turned inside out by a depth reversal."""
_BUNDLE_ITERATIONS, _ROUNDS = 15, 2


def move_to_refined(
    object_map: ObjectMap, camera: Camera, start: RefinedStart, config: OnlineConfig
) -> ObjectMap | None:
    """The map with the refined surface and poses; keyframes without a refined pose are refined to fit them.

    Landmarks move with the vertex that is nearest. Keyframes with a refined pose keep it.

    Args:
        object_map: The map that the causal estimates end with.
        camera: Its camera.
        start: The earlier refinement.
        config: The solver's options.

    Returns:
        None if the refined surface is not this map's.
    """
    if object_map.fixed_keyframes or len(start.vertices) != len(object_map.vertices):
        return None
    before = object_map.vertices.double().cpu().numpy()
    placed = [view for view in object_map.keyframes if view.index in start.refined]
    if not placed:
        return None
    turn = _turn_of_object(*pose_arrays(placed[0].pose), camera, start, placed[0].index)
    moved = before @ turn[:3, :3].T + turn[:3, 3]
    bent = np.linalg.norm(moved - start.vertices, axis=1)
    if np.median(bent) > _MOST_BENT * object_map.radius * start.scale:
        return None
    landmarks = object_map.landmarks @ turn[:3, :3].T + turn[:3, 3]
    known = np.isfinite(landmarks).all(1)
    nearest = cKDTree(moved).query(landmarks[known])[1]
    landmarks[known] += (start.vertices - moved)[nearest]
    keyframes = []
    for view in object_map.keyframes:
        seen = with_focal_length(view, camera, start.camera)
        R, t = pose_arrays(view.pose)
        T = start.predict(view.index, _matrix(R, t), camera.fx)
        keyframes.append(
            replace(seen, pose=pose_from_arrays(T[:3, :3], T[:3, 3], object_map.vertices), texture=None)
        )
    vertices = torch.as_tensor(
        start.vertices, dtype=object_map.vertices.dtype, device=object_map.vertices.device
    )
    object_map = replace(object_map, vertices=vertices, landmarks=landmarks, keyframes=tuple(keyframes))
    object_map = _fit_new_keyframes(object_map, start.camera, start.refined, config)
    return object_map.with_textures()


def project_landmarks(object_map: ObjectMap, camera: Camera, pose: Pose) -> FollowedPoints:
    """The landmarks that a frame shows, at the pixels where its pose puts them: those of the keyframe most like it."""
    R, t = pose_arrays(pose)
    alike = max(object_map.keyframes, key=lambda view: float(np.sum(pose_arrays(view.pose)[0] * R)))
    numbers = np.unique(alike.points.landmark[~object_map.candidate[alike.points.landmark]])
    seen = object_map.landmarks[numbers] @ R.T + t
    ahead = np.isfinite(seen).all(1) & (seen[:, 2] > 0)
    numbers, screen = numbers[ahead], seen[ahead] @ camera.K.T
    return FollowedPoints(numbers, (screen[:, :2] / screen[:, 2:]).astype(alike.points.pixel.dtype))


def _fit_new_keyframes(
    object_map: ObjectMap, camera: Camera, refined: Mapping[int, NDArray[np.float64]], config: OnlineConfig
) -> ObjectMap:
    """The map with the keyframes that have no refined pose, and the surface, fitted to the other keyframes."""
    views = object_map.keyframes
    new = [place for place, view in enumerate(views) if view.index not in refined]
    if not new or object_map.pointless:
        return object_map
    held = [place for place in range(len(views)) if place not in new]
    nearest = sorted(held, key=lambda place: min(abs(place - other) for other in new))
    held = sorted(nearest[: max(config.local_window - len(new), config.local_window // 2)])
    return refine_map(
        object_map,
        camera,
        [*held, *new],
        weights=FitWeights(smoothness=config.smoothness),
        prior=config.surface_prior,
        bundle_iterations=_BUNDLE_ITERATIONS,
        rounds=_ROUNDS,
        fixed=len(held),
    )


def _turn_of_object(
    R: NDArray[np.float64], t: NDArray[np.float64], camera: Camera, start: RefinedStart, index: int
) -> NDArray[np.float64]:
    """``(4, 4)`` the similarity from the map's object coordinates to the refined ones, by a keyframe that has both."""
    T = _matrix(R, t)
    T[:3, 3] *= start.scale
    T[2, 3] *= start.camera.fx / camera.fx
    turn = np.linalg.inv(start.refined[index]) @ T
    turn[:3, :3] *= start.scale
    return turn


def _matrix(R: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T
