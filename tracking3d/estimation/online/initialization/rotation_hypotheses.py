"""Hypotheses for an initialization without points: rotation about an image axis, none, and what is near one."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

TURN = 35.0
"""Degrees of rotation from the first view to the last, in eight directions. Varied, they are 21 to 56 (measured)."""
PROFILES = ((0.0, 1.0), (0.5, 1.0), (0.0, 0.5))
"""Parts of the time in which the object turns: a hand takes a thing before it turns it, or then holds it still."""
DIRECTIONS = 8
_VARIED_EXTENTS = (0.6, 1.6)  # times the rotation (chosen)
_VARIED_AXES = (-22.0, 22.0)  # degrees in the image plane, half of what lies between two directions
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
    if first.mask is None or view.mask is None:
        return first.pose.translation
    (x0, y0), (x1, y1) = (np.argwhere(mask)[:, ::-1].mean(0) for mask in (first.mask, view.mask))
    ratio = float(np.clip(math.sqrt(first.mask.sum() / view.mask.sum()), 0.5, 2.0))
    depth = float(first.pose.translation[2])
    shift = first.pose.translation.new_tensor(
        [(x1 - x0) / camera.fx * depth, (y1 - y0) / camera.fy * depth, 0.0]
    )
    return (first.pose.translation + shift) * ratio
