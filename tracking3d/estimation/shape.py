"""The part of an object that does not change while it is estimated, and priors of its shape: flat, not folded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.config.models import ObjectConfig
from tracking3d.errors import InputError
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.mesh import Mesh, uniform_laplacian
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.geometry.prototypes import ellipsoid, from_file, sphere
from tracking3d.rendering import BackProjection

_MAX_FOLDED = 0.01  # share of the surface's area that may be folded (chosen)
_MAX_ROUNDS = 12  # of smoothing a fold (chosen)


@dataclass(frozen=True, eq=False)
class Shape:
    """The fixed part of the object: prototype, topology and atlas."""

    rest: Tensor  # (V, 3) vertices of the prototype
    faces: Tensor  # (F, 3) int64
    face_uvs: Tensor  # (F, 3, 2)
    laplacian: Tensor  # sparse (V, V)
    flat: bool  # whether all vertices stay in one plane

    @classmethod
    def of(cls, mesh: Mesh, flat: bool, device: torch.device) -> Shape:
        """Take a prototype mesh to a device."""
        faces = torch.from_numpy(mesh.faces).to(device)
        laplacian = uniform_laplacian(faces, len(mesh.vertices)).to(device)
        return cls(
            torch.from_numpy(mesh.vertices).float().to(device),
            faces,
            torch.from_numpy(mesh.face_uvs).float().to(device),
            laplacian,
            flat,
        )


def flatten(vertices: Tensor) -> Tensor:
    """Project ``(V, 3)`` onto their best-fitting plane: the flat prior (paper section 4.2)."""
    centre = vertices.mean(0)
    _, _, axes = torch.linalg.svd(vertices - centre, full_matrices=False)
    normal = axes[2]
    return vertices - ((vertices - centre) @ normal)[:, None] * normal


def unfold(shape: Shape, vertices: Tensor) -> Tensor:
    """The surface of an object without points, with its folds smoothed away.

    A folded surface fits any outline, and any sense of turning. A face that looks at the middle of the surface belongs
    to a fold or to a cavity, and without points nothing measures the depth of a cavity. Vertices of such faces are
    moved to the mean of their neighbours, until hardly any of the surface is folded.

    Args:
        shape: The topology.
        vertices: ``(V, 3)``.
    """
    if shape.flat:
        return vertices
    for _ in range(_MAX_ROUNDS):
        a, b, c = vertices[shape.faces].unbind(1)
        normal, centre = torch.linalg.cross(b - a, c - a), (a + b + c) / 3
        area = normal.norm(dim=1)
        middle = (centre * area[:, None]).sum(0) / area.sum()
        inward = ((centre - middle) * normal).sum(1) < 0
        if float((inward * area).sum()) <= _MAX_FOLDED * float(area.sum()):
            break
        moved = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
        moved[shape.faces[inward].flatten()] = True
        vertices = torch.where(moved[:, None], vertices - shape.laplacian @ vertices, vertices)
    return vertices


def visible_texture(seen: BackProjection) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """RGB texture ``(T, T, 3)`` and how much each texel was seen ``(T, T)``.

    Texels that were never seen continue their neighbours smoothly; their weight stays zero.
    """
    weight = seen.weight.cpu().numpy()
    values = seen.mean().clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).cpu().numpy()
    unseen = (weight <= 0).astype(np.uint8)
    if not unseen.any() or unseen.all():
        return values, weight
    # Repeating a margin on both sides lets the inpainting wrap around in u.
    margin = values.shape[1] // 8
    padded = np.concatenate([values[:, -margin:], values, values[:, :margin]], 1)
    holes = np.concatenate([unseen[:, -margin:], unseen, unseen[:, :margin]], 1)
    filled = cv2.inpaint(padded, holes, 3, cv2.INPAINT_TELEA)
    return np.ascontiguousarray(filled[:, margin:-margin]), weight


# The initialization from the first mask: a prototype and a pose whose projection fits it.
#
# The unit is set so that the object's radius is about `RADIUS`; learning rates, Laplacian weight and tolerances
# assume it.

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
