"""What views show of faces, and the joint normal equations, in torch: one step after the other, nothing fused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from torch import Tensor
from torch.nn import functional

from tracking3d.estimation.online.optimization.shading import OutlineResiduals
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.rendering import Rendering
from tracking3d.rendering.normal_equations import screen_motion

_DEPTH_TOLERANCE = 0.05
_GRAZING = 0.1
_LITTLE = 0.05
_SINGLE = 0.5
_RIDGE = 1e-3
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class SharedFaces:
    """What B views show of the faces that two views or more show, C channels."""

    cost: float  # the mean Cauchy loss, of what one view alone shows too
    faces: Tensor  # (N,) int64, which they are
    # (N, B, 3, 3) in the cameras' axes; normal: (N, B, 3); length: (N, B, 1), twice their areas
    corner: Tensor
    normal: Tensor
    length: Tensor
    slopes: tuple[Tensor, Tensor]  # two of (N, B, C), of the values by x and by y
    light: Tensor  # (C, 3)
    residual: Tensor  # (N, B, C); used: (N, B, C) their weights as in the matrix of the Cauchy loss
    used: Tensor
    K: Tensor  # (B, 3, 3)
    scale: float  # difference of features at which the loss is log 2


@dataclass(frozen=True, eq=False)
class FaceEquations:
    """A quadratic model of the mean Cauchy loss over what B views show, C channels.

    The G further unknowns are the poses' ``(v, w)``, six for each view, see `NormalEquations`, and the light's three
    for each channel.
    """

    faces: Tensor  # (N,) int64, the faces that two views or more show
    corners: Tensor  # (N, 9, 9) matrix in each face's corners, in object coordinates
    mixed: Tensor  # (N, 9, G) between corners and the rest; rest: (G, G)
    rest: Tensor
    by_corners: Tensor  # (N, 9) gradient; by_rest: (G,)
    by_rest: Tensor


@torch.no_grad()
def shared_faces(drawn: Rendering, layers: Tensor, scale: float) -> SharedFaces:
    """What the views show of the same faces at the present shape and poses.

    Args:
        drawn: The rendering.
        layers: From `layers_of`.
        scale: Difference of features at which the loss is ``log 2``.
    """
    corner = drawn.x_cam[:, drawn.faces].transpose(0, 1)  # (F, B, 3, 3)
    a, b, c = corner.unbind(2)
    double_area = torch.linalg.cross(b - a, c - a)
    length = double_area.norm(dim=2, keepdim=True).clamp_min(1e-12)
    normal = double_area / length
    weight, sampled = _weights(drawn, corner.mean(2), normal, layers)
    seen = (weight > _LITTLE * weight.amax(1, keepdim=True)) & (weight > 0)
    faces = torch.nonzero(seen.sum(1) >= 2)[:, 0]
    whole = weight.sum().clamp_min(1e-9)
    single = float(1 - weight[faces].sum() / whole)
    corner, normal, length = corner[faces], normal[faces], length[faces]
    count = (layers.shape[1] - 1) // 3
    value, by_x, by_y = sampled[faces].split(count, 2)  # (N, B, C)
    full = (weight[faces] / (whole * count))[..., None].expand_as(value)
    light, residual, used = _shade(value, normal, full, scale)
    cost = float((full * torch.log1p(residual.square() / scale**2)).sum()) + _SINGLE * single
    cost += _RIDGE * float(light.square().sum()) / (count * scale**2)
    return SharedFaces(
        cost, faces, corner, normal, length, (by_x, by_y), light, residual, used, drawn.K, scale
    )


@torch.no_grad()
def face_equations(shown: SharedFaces, R: Tensor, t: Tensor) -> FaceEquations:
    """The model at the present shape and poses, ``R`` ``(B, 3, 3)`` and ``t`` ``(B, 3)``."""
    faces, corner, normal, length = shown.faces, shown.corner, shown.normal, shown.length
    (by_x, by_y), light, used = shown.slopes, shown.light, shown.used
    frames, count = len(R), len(light)
    # Derivatives of a view's value, less the light's part, by the corners in the camera's axes.
    middle = corner.mean(2).reshape(-1, 3)
    K = shown.K.repeat(len(faces), 1, 1)
    motion = screen_motion(middle, K, middle)[:, :, :3].reshape(len(faces), frames, 2, 3)
    moving = by_x[..., None] * motion[:, :, None, 0] + by_y[..., None] * motion[:, :, None, 1]  # (N, B, C, 3)
    across = light - (normal @ light.T)[..., None] * normal[:, :, None]
    opposite = (corner.roll(-2, 2) - corner.roll(-1, 2)) / length[..., None]  # (N, B, 3, 3)
    turning = torch.linalg.cross(across[:, :, :, None], opposite[:, :, None])
    by_corner = moving[:, :, :, None] / 3 - turning  # (N, B, C, 3, 3)
    arm = (corner - t[:, None])[:, :, None]
    by_pose = torch.cat([by_corner.sum(3), torch.linalg.cross(arm, by_corner).sum(3)], 3)  # (N, B, C, 6)
    by_corner = (by_corner @ R[:, None]).flatten(3)  # (N, B, C, 9)

    # Taking off the weighted mean over the views eliminates the own colour; one side of each product suffices.
    total = used.sum(1).clamp_min(1e-20)  # (N, C)
    share = (used / total[:, None])[..., None]
    centred = used[..., None] * (by_corner - (share * by_corner).sum(1, keepdim=True))
    pull = used[..., None] * by_pose
    tilt = normal[:, :, None] - (share * normal[:, :, None]).sum(1, keepdim=True)  # (N, B, C, 3)
    corners = centred.flatten(1, 2).mT @ by_corner.flatten(1, 2)
    with_poses = (centred.mT @ by_pose).transpose(1, 2).reshape(len(faces), 9, 6 * frames)
    with_light = -(centred.transpose(1, 2).mT @ normal[:, None]).transpose(1, 2).flatten(2)
    flat = pull.permute(0, 2, 1, 3).flatten(2)  # (N, C, 6 B)
    spread = (flat / total.sqrt()[..., None]).flatten(0, 1)
    own = [
        p.flatten(0, 1).T @ q.flatten(0, 1) for p, q in zip(pull.unbind(1), by_pose.unbind(1), strict=True)
    ]
    poses = torch.block_diag(*own) - spread.T @ spread
    poses_light = -torch.einsum("nbcp,nbci->bpci", pull, tilt).reshape(6 * frames, 3 * count)
    per_channel = torch.einsum("nbc,nbi,nbcj->cij", used, normal, tilt)
    ridge = torch.eye(3).to(tilt) * (2 * _RIDGE / (count * shown.scale**2))
    lights = torch.block_diag(*(per_channel + ridge))
    rest = torch.cat([torch.cat([poses, poses_light], 1), torch.cat([poses_light.T, lights], 1)])
    error = (used * shown.residual)[..., None]
    return FaceEquations(
        faces,
        corners,
        torch.cat([with_poses, with_light], 2),
        rest,
        (error * by_corner).sum((1, 2)),
        torch.cat([(error * by_pose).sum((0, 2)).flatten(), poses.new_zeros(3 * count)]),
    )


def _weights(drawn: Rendering, middle: Tensor, normal: Tensor, layers: Tensor) -> tuple[Tensor, Tensor]:
    """What each view's sight of each face counts ``(F, B)``, and the sampled layers ``(F, B, 3 C)`` there."""
    x, y, z = middle.unbind(2)
    K, size = drawn.K, layers.shape[-1]
    pixel = torch.stack([K[:, 0, 0] * x / z + K[:, 0, 2], K[:, 1, 1] * y / z + K[:, 1, 2]], 2)
    grid = ((2 * pixel + 1) / size - 1).transpose(0, 1)[:, None]  # (B, 1, F, 2)
    sampled = functional.grid_sample(layers, grid, align_corners=False)[:, :, 0].permute(2, 0, 1)
    depth = torch.where(drawn.depth.isinf(), 0.0, drawn.depth)[:, None]
    front = functional.grid_sample(depth, grid, mode="nearest", align_corners=False)[:, 0, 0].T
    cosine = -(normal * functional.normalize(middle, dim=2)).sum(2)
    radius = (drawn.x_cam[0] - drawn.x_cam[0].mean(0)).norm(dim=1).max()
    visible = (
        (cosine > _GRAZING)
        & (front > 0)
        & (z < front + _DEPTH_TOLERANCE * radius / cosine.clamp_min(_GRAZING))
    )
    a, b, c = drawn.screen[:, drawn.faces].transpose(0, 1).unbind(2)
    u, v = b - a, c - a
    pixels = (u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]).abs() / 2
    return visible * pixels * cosine.clamp_min(0) * sampled[..., -1], sampled[..., :-1]


def _shade(value: Tensor, normal: Tensor, full: Tensor, scale: float) -> tuple[Tensor, Tensor, Tensor]:
    """The light ``(C, 3)``, the residuals ``(N, B, C)``, and their weights as in the matrix of the Cauchy loss."""
    used, residual = full, value
    light = value.new_zeros(value.shape[2], 3)
    ridge = torch.eye(3).to(value) * (_RIDGE / value.shape[2])
    for _ in range(_ROUNDS):
        share = used / used.sum(1, keepdim=True).clamp_min(1e-20)
        tilt = normal[:, :, None] - (share[..., None] * normal[:, :, None]).sum(1, keepdim=True)
        matrix = torch.einsum("nbc,nbci,nbcj->cij", used, tilt, tilt) + ridge
        light = torch.linalg.solve(matrix, torch.einsum("nbc,nbci,nbc->ci", used, tilt, value))
        own = value - normal @ light.T
        residual = own - (share * own).sum(1, keepdim=True)
        used = full / (1 + residual.square() / scale**2)
    return light, residual, used * (2 / scale**2)


def project_on_basis(shown: FaceEquations, modes: ShapeBasis, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Matrix and gradient of face equations in ``(3 M + G)`` unknowns; a mode's three directions are neighbours.

    Args:
        shown: In the corners of faces and G further unknowns.
        modes: The modes of the shape.
        faces: ``(F, 3)`` of the shape.
    """
    corner = faces[shown.faces]
    vertices, count = modes.vectors.shape
    rows = corner[:, :, None].expand(-1, 3, 3).flatten().cpu().numpy()
    columns = corner[:, None].expand(-1, 3, 3).flatten().cpu().numpy()
    blocks = shown.corners.double().reshape(-1, 3, 3, 3, 3).cpu().numpy()  # (N, corner, xyz, corner, xyz)
    basis = modes.vectors.cpu().numpy()
    shape = np.zeros((count, 3, count, 3))
    for i in range(3):
        for j in range(i, 3):
            entries = sparse.csr_matrix(
                (blocks[:, :, i, :, j].ravel(), (rows, columns)), shape=(vertices, vertices)
            )
            part = basis.T @ (entries @ basis)
            shape[:, i, :, j], shape[:, j, :, i] = part, part.T
    at_corners = torch.cat([shown.mixed, shown.by_corners[..., None]], 2)
    width = at_corners.shape[2]
    at_vertices = at_corners.new_zeros(vertices, 3 * width).index_add(
        0, corner.flatten(), at_corners.reshape(-1, 3 * width)
    )
    mixed = (modes.vectors.to(at_vertices).T @ at_vertices).reshape(3 * count, width).double()
    top = torch.cat([torch.from_numpy(shape.reshape(3 * count, 3 * count)).to(mixed), mixed[:, :-1]], 1)
    bottom = torch.cat([mixed[:, :-1].T, shown.rest.double()], 1)
    return torch.cat([top, bottom]), torch.cat([mixed[:, -1], shown.by_rest.double()])


def outline_rows(
    outlines: OutlineResiduals, modes: ShapeBasis, K: Tensor, R: Tensor, t: Tensor
) -> tuple[Tensor, Tensor]:
    """The outlines' Jacobian in modes and poses ``(N, 3 M + 6 B)``, and the same by its robust weights."""
    contour, slope, vectors = outlines.contour, outlines.slope, modes.vectors
    view = contour.view
    motion = screen_motion(contour.points, K[view], t[view])
    by_pose = torch.einsum("ni,nia->na", slope, motion)
    by_object = torch.einsum("na,nab->nb", by_pose[:, :3], R[view])
    mode = (contour.share[:, :, None] * vectors.to(slope)[contour.vertices]).sum(1)
    by_mode = (mode[:, :, None] * by_object[:, None]).flatten(1)
    by_poses = by_pose.new_zeros(len(view), contour.frames, 6)
    by_poses[torch.arange(len(view)), view] = by_pose
    jacobian = torch.cat([by_mode, by_poses.flatten(1)], 1)
    return jacobian, jacobian * outlines.weight[:, None]


def normal_equations(
    shown: SharedFaces,
    outlines: OutlineResiduals,
    factor: float,
    R: Tensor,
    t: Tensor,
    modes: ShapeBasis,
    faces: Tensor,
) -> tuple[Tensor, Tensor]:
    """Matrix and gradient of both costs together."""
    matrix, gradient = (factor * part for part in project_on_basis(face_equations(shown, R, t), modes, faces))
    jacobian, weighted = (rows.double() for rows in outline_rows(outlines, modes, shown.K, R, t))
    count = jacobian.shape[1]
    matrix[:count, :count] += jacobian.T @ weighted
    gradient[:count] += weighted.T @ outlines.residual.double()
    return matrix, gradient
