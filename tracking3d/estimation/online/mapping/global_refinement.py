"""All keyframes together once more, and the lens where nobody gave it; kept only if that explains them better."""

from __future__ import annotations

import numpy as np

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online.mapping.focal_length import lens_change, solve_lens
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose, render_cost
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.geometry.camera import Camera

_PASSES = 3
_FOCAL_LENGTH_PENALTY = 0.01
"""Cost by which a lens twice as long or short has to explain the keyframes better than the one at hand."""


def refine_globally(object_map: ObjectMap, camera: Camera, config: OnlineConfig) -> tuple[ObjectMap, Camera]:
    """The map and the camera that re-render the keyframes best: as they are, refined, or refined with a solved lens.

    Points fit better with every freedom that they are given; what is drawn does so only where it is true. Without
    that brake a refinement can end worse than it began. A map whose shape is held stays as it is.

    Args:
        object_map: The map.
        camera: Of the full frame; another lens is tried where it is assumed.
        config: Of the solver.
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
    """What the keyframes cost at their poses, in the mean: pixels, outlines, and what is missed of the masks."""
    surface = object_map.surface()
    costs = []
    for view in object_map.keyframes:
        fit = refine_pose(surface, view.observation, view.pose, iterations=(0,))
        costs.append(render_cost(fit, PoseWeights(), view.mask_weight))
    return float(np.mean(costs)) if costs else 0.0


def _refine_with_lens(
    object_map: ObjectMap, camera: Camera, config: OnlineConfig
) -> tuple[float, ObjectMap, Camera]:
    everything = list(range(len(object_map.keyframes)))
    for _ in range(_PASSES):
        object_map = refine_local_map(object_map, camera, everything, config, bundle_iterations=15, rounds=2)
    return keyframe_cost(object_map), object_map, camera
