"""Hypotheses for an initialization without points: steady rotation about an image axis, or no rotation."""

from __future__ import annotations

import math

import numpy as np
import torch

from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

TURNS = (20.0, 50.0)
"""Degrees of rotation from the first view to the last."""
DIRECTIONS = 8


def rotation_hypotheses(views: list[Keyframe], camera: Camera) -> list[tuple[str, list[Pose]]]:
    """Poses of the views for no rotation, and for turning steadily in eight directions, by two angles; with names.

    Translations follow the masks' centres and sizes.
    """
    first = views[0].pose
    placed = [_place_views(views[0], view, camera) for view in views]
    found = [("no rotation", [Pose(translation, first.quaternion) for translation in placed])]
    frames = max(views[-1].index - views[0].index, 1)
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = first.translation.new_tensor([math.cos(angle), math.sin(angle), 0.0])
        for turn in TURNS:
            degrees = [turn * (view.index - views[0].index) / frames for view in views]
            poses = [
                from_matrix(rotation_about(axis, part) @ first.R, translation)
                for part, translation in zip(degrees, placed, strict=True)
            ]
            found.append((f"rotation {round(math.degrees(angle))}", poses))
    return found


def _place_views(first: Keyframe, view: Keyframe, camera: Camera) -> torch.Tensor:
    """The first translation moved so that it projects to a view's mask."""
    if first.mask is None or view.mask is None:
        return first.pose.translation
    (x0, y0), (x1, y1) = (np.argwhere(mask)[:, ::-1].mean(0) for mask in (first.mask, view.mask))
    ratio = float(np.clip(math.sqrt(first.mask.sum() / view.mask.sum()), 0.5, 2.0))
    depth = float(first.pose.translation[2])
    shift = first.pose.translation.new_tensor(
        [(x1 - x0) / camera.fx * depth, (y1 - y0) / camera.fy * depth, 0.0]
    )
    return (first.pose.translation + shift) * ratio
