"""All keyframes together once more, and the lens where nobody gave it; kept only if that explains them better."""

from __future__ import annotations

import numpy as np

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online.belief import ObjectMap
from tracking3d.estimation.online.growing import refined
from tracking3d.estimation.online.lens import lens_change, solve_lens
from tracking3d.estimation.online.pose_refinement import refine_pose
from tracking3d.estimation.online.pose_refinement_types import PoseWeights
from tracking3d.estimation.online.tracking import evidence
from tracking3d.geometry.camera import Camera

_PASSES = 3
_LENS_CHARGE = 0.01
"""Cost by which a lens twice as long or short has to explain the keyframes better than the one at hand."""


def refined_once_more(known: ObjectMap, camera: Camera, config: OnlineConfig) -> tuple[ObjectMap, Camera]:
    """The map and the camera that re-render the keyframes best: as they are, refined, or refined with a solved lens.

    Points fit better with every freedom that they are given; what is drawn does so only where it is true. Without
    that brake a refinement can end worse than it began. A map whose shape is held stays as it is.

    Args:
        known: The map.
        camera: Of the full frame; another lens is tried where it is assumed.
        config: Of the solver.
    """
    if known.held:
        return known, camera
    tried = [(keyframe_cost(known), known, camera), _refined(known, camera, config)]
    if camera.assumed:
        with_lens, solved = solve_lens(known, camera)
        if solved != camera:
            cost, better, _ = _refined(with_lens, solved, config)
            tried.append((cost + _LENS_CHARGE * lens_change(solved.fy / camera.fy), better, solved))
    _, known, camera = min(tried, key=lambda one: one[0])
    return known, camera


def keyframe_cost(known: ObjectMap) -> float:
    """What the keyframes cost at their poses, in the mean: pixels, outlines, and what is missed of the masks."""
    surface = known.surface()
    costs = []
    for view in known.keyframes:
        fit = refine_pose(surface, view.observation, view.pose, iterations=(0,))
        costs.append(evidence(fit, PoseWeights(), view.mask_weight))
    return float(np.mean(costs)) if costs else 0.0


def _refined(known: ObjectMap, camera: Camera, config: OnlineConfig) -> tuple[float, ObjectMap, Camera]:
    everything = list(range(len(known.keyframes)))
    for _ in range(_PASSES):
        known = refined(known, camera, everything, config, bundle_iterations=15, rounds=2)
    return keyframe_cost(known), known, camera
