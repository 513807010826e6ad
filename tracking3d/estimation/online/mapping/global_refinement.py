"""Refines all keyframes together, and the focal length if it is not given; kept only if the rendering cost falls."""

from __future__ import annotations

import numpy as np

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online.mapping.focal_length import lens_change, solve_lens
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose, render_cost
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.geometry.camera import Camera

_PASSES = 3
_FOCAL_LENGTH_PENALTY = 0.01
"""Cost by which twice or half the focal length must explain the keyframes better than the current one."""


def refine_globally(object_map: ObjectMap, camera: Camera, config: OnlineConfig) -> tuple[ObjectMap, Camera]:
    """The map and the camera with the least rendering cost: unchanged, refined, or refined with the focal length.

    Reprojection errors fall with every additional unknown; the rendering cost falls only if the map gets better.
    Without this check a refinement can end worse than it began. A map with a fixed shape stays unchanged.

    Args:
        object_map: The map.
        camera: The camera of the full frame; if its focal length is assumed, another one is tried.
        config: The solver's options.
    """
    if object_map.fixed_keyframes:
        return object_map, camera
    tried = [(keyframe_cost(object_map), object_map, camera), _refine_with_lens(object_map, camera, config)]
    if camera.assumed:
        with_lens, solved = solve_lens(object_map, camera)
        if solved != camera:
            cost, better, _ = _refine_with_lens(with_lens, solved, config)
            tried.append((cost + _FOCAL_LENGTH_PENALTY * lens_change(solved.fy / camera.fy), better, solved))
    _, object_map, camera = min(tried, key=lambda one: one[0])
    return object_map, camera


def keyframe_cost(object_map: ObjectMap) -> float:
    """The mean cost of the keyframes at their poses: pixels, outlines, and uncovered parts of the masks."""
    costs = [
        render_cost(fit, PoseWeights(), view.mask_weight)
        for fit, view in zip(fit_keyframes(object_map), object_map.keyframes, strict=True)
    ]
    return float(np.mean(costs)) if costs else 0.0


def fit_keyframes(object_map: ObjectMap) -> list[PoseFit]:
    """The losses of the keyframes at their poses, which stay."""
    surface = object_map.surface()
    return [
        refine_pose(surface, view.observation, view.pose, iterations=(0,)) for view in object_map.keyframes
    ]


def _refine_with_lens(
    object_map: ObjectMap, camera: Camera, config: OnlineConfig
) -> tuple[float, ObjectMap, Camera]:
    everything = list(range(len(object_map.keyframes)))
    for _ in range(_PASSES):
        object_map = refine_local_map(object_map, camera, everything, config, bundle_iterations=15, rounds=2)
    return keyframe_cost(object_map), object_map, camera
