"""Starts without points: the object turns about an axis of the image at some rate, or not at all.

Each hypothesis is improved by turns: the shape by the outlines, the texture by what the views show, every pose by
both. Where points are too few to tell, the one that re-renders the first frames best is the start.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.mapping import fit_shape
from tracking3d.estimation.online.pose_refinement import PoseWeights, refine_pose
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

RATES = (3.0, 8.0)
"""Degrees a frame that the hypotheses turn."""
DIRECTIONS = 8
_MOST_TURN = 60.0


def turning_hypotheses(views: list[View], camera: Camera) -> list[tuple[str, list[Pose]]]:
    """Poses of the views for no rotation, and for turning in eight directions at two rates; each with a name.

    Translations follow the masks' centres and sizes.
    """
    first = views[0].pose
    placed = [_placed(views[0], view, camera) for view in views]
    found = [("still", [Pose(translation, first.quaternion) for translation in placed])]
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = first.translation.new_tensor([math.cos(angle), math.sin(angle), 0.0])
        for rate in RATES:
            poses = []
            for view, translation in zip(views, placed, strict=True):
                degrees = min(rate * (view.index - views[0].index), _MOST_TURN)
                poses.append(from_matrix(rotation_about(axis, degrees) @ first.R, translation))
            found.append((f"turning {round(math.degrees(angle))}", poses))
    return found


def improved(known: ObjectMap, weights: FitWeights, rounds: int, iterations: tuple[int, ...]) -> tuple[ObjectMap, float]:
    """A map's shape and poses, the first one's aside, improved by turns; and how badly it re-renders its views."""
    everything = list(range(len(known.keyframes)))
    cost = math.inf
    for _ in range(rounds):
        known = fit_shape(known, everything, weights, 1)
        known = replace(known, keyframes=tuple(replace(view, texture=None) for view in known.keyframes))
        surface = known.surface()
        fits = [
            refine_pose(surface, view.observation, view.pose, None, PoseWeights(outline=0.3 * view.mask_weight), iterations if n else tuple(0 for _ in iterations))
            for n, view in enumerate(known.keyframes)
        ]
        cost = float(np.mean([fit.cost for fit in fits]))
        known = replace(
            known, keyframes=tuple(replace(v, pose=f.pose) for v, f in zip(known.keyframes, fits, strict=True))
        )
    return known, cost


def _placed(first: View, view: View, camera: Camera) -> torch.Tensor:
    """The first translation moved to where a view's mask is."""
    assert first.mask is not None
    if view.mask is None:
        return first.pose.translation
    (x0, y0), (x1, y1) = (np.argwhere(v.mask)[:, ::-1].mean(0) for v in (first, view))
    ratio = float(np.clip(math.sqrt(first.mask.sum() / view.mask.sum()), 0.5, 2.0))
    depth = float(first.pose.translation[2])
    shift = first.pose.translation.new_tensor([(x1 - x0) / camera.fx * depth, (y1 - y0) / camera.fy * depth, 0.0])
    return (first.pose.translation + shift) * ratio
