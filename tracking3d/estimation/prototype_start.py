"""The initialization from the first mask: a prototype and a pose whose projection fits it.

The unit is set so that the object's radius is about `RADIUS`; learning rates, Laplacian weight and tolerances
assume it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.config.models import ObjectConfig
from tracking3d.errors import InputError
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.geometry.prototypes import ellipsoid, from_file, sphere

RADIUS = 0.9
"""Radius of the object's largest half-axis in object units."""
_ELONGATED = 1.1  # ratio of an ellipse's axes from which its direction is known (chosen)


@dataclass(frozen=True, eq=False)
class MaskEllipse:
    """The ellipse with a mask's second moments, in pixels of the full frame."""

    centre: NDArray[np.float64]  # (2,)
    semi_axes: NDArray[np.float64]  # (2,), the longer first
    directions: NDArray[np.float64]  # (2, 2), columns are the axes' unit directions


def first_mask(frame: Frame, mask: MaskEstimate) -> NDArray[np.bool_]:
    """The first frame's mask ``(H, W)``, which no solver can do without.

    Raises:
        InputError: If it is missing or empty.
    """
    binary = mask.binary
    if binary is None or not binary.any():
        raise InputError(
            f"{frame.name or 'The first frame'} has no object: its mask is empty; give another box or mask."
        )
    return binary


def mask_ellipse(mask: NDArray[np.bool_]) -> MaskEllipse:
    """Fit an ellipse to a non-empty mask ``(H, W)``."""
    points = np.argwhere(mask)[:, ::-1].astype(np.float64)
    centre = points.mean(0)
    # One pixel's own variance keeps thin masks from having no width.
    covariance = (points - centre).T @ (points - centre) / len(points) + np.eye(2) / 12
    variances, directions = np.linalg.eigh(covariance)
    return MaskEllipse(centre, 2 * np.sqrt(variances[::-1]), directions[:, ::-1])


def first_translation(ellipse: MaskEllipse, camera: Camera) -> NDArray[np.float64]:
    """Translation ``(3,)`` that projects an object of radius `RADIUS` onto the mask."""
    focal = math.sqrt(camera.fx * camera.fy)
    # The outline of a sphere is seen at the angle asin(r / z), a little wider than r / z.
    tangent = ellipse.semi_axes[0] / focal
    depth = RADIUS * math.sqrt(1 + 1 / tangent**2)
    x = (ellipse.centre[0] - camera.cx) / camera.fx
    y = (ellipse.centre[1] - camera.cy) / camera.fy
    return np.array([x * depth, y * depth, depth])


def place_on_mask(rest: Tensor, camera: Camera, mask: NDArray[np.bool_]) -> Pose:
    """The pose of the prototype on a later mask: as near as that is large, and turned in the image as it lies.

    Args:
        rest: ``(V, 3)`` the prototype, as `prototype_mesh` makes it from the first mask.
        camera: The camera of the full frame.
        mask: ``(H, W)``, not empty.
    """
    ellipse = mask_ellipse(mask)
    variances, directions = np.linalg.eigh(np.cov(rest[:, :2].double().cpu().numpy().T))
    (x0, y0), (x1, y1) = directions[:, 1], ellipse.directions[:, 0]
    turn = math.degrees(math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1))
    turn = (turn + 90) % 180 - 90  # an ellipse looks the same after half a turn
    if min(variances[1] / variances[0], np.divide(*ellipse.semi_axes) ** 2) < _ELONGATED**2:
        turn = 0.0  # the axes of what is nearly round point anywhere
    translation = rest.new_tensor(first_translation(ellipse, camera))
    return from_matrix(rotation_about(rest.new_tensor([0.0, 0.0, 1.0]), turn), translation)


def prototype_mesh(config: ObjectConfig, ellipse: MaskEllipse) -> Mesh:
    """The prototype in object units: ``sphere``, ``ellipsoid`` fitted to the first mask, or a mesh file.

    Raises:
        InputError: If a mesh file cannot be used.
    """
    if config.prototype == "sphere":
        radius = RADIUS * math.sqrt(ellipse.semi_axes[1] / ellipse.semi_axes[0])
        mesh = sphere(config.frequency)
        return Mesh(mesh.vertices * radius, mesh.faces, mesh.face_uvs)
    if config.prototype == "ellipsoid":
        long, short = RADIUS, RADIUS * ellipse.semi_axes[1] / ellipse.semi_axes[0]
        axes = np.array([long, short, math.sqrt(long * short)])
        rotation = np.eye(3)
        rotation[:2, :2] = ellipse.directions
        if np.linalg.det(rotation) < 0:
            rotation[:, 1] *= -1
        return _stretch(axes, rotation, config.frequency)
    mesh = from_file(Path(config.prototype))
    return Mesh(mesh.vertices * RADIUS, mesh.faces, mesh.face_uvs)


def _stretch(axes: NDArray[np.float64], rotation: NDArray[np.float64], frequency: int) -> Mesh:
    # Stretching along the image axes' ellipse keeps the atlas upright: rotate in, stretch, rotate back.
    unit = ellipsoid(np.ones(3), np.eye(3), frequency)
    return Mesh(unit.vertices @ rotation @ np.diag(axes) @ rotation.T, unit.faces, unit.face_uvs)
