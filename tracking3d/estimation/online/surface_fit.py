"""The shape, given the poses: vertices whose outlines and surface fit the masks and the landmarks.

Gauss-Newton on three terms: the signed distances of the outline in every keyframe, the distances of the landmarks
from the surface that is seen where they are, and the Laplacian of the offsets from the prototype. The normal
equations are sparse; contour and attachments are found anew in every round.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from torch import Tensor

from tracking3d.rendering import Rendering, find_contour, rasterize, render
from tracking3d.rendering.contour import contour_slopes

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class FitWeights:
    """What each term of the shape counts.

    Attributes:
        outline: Of the mean squared outline distance of a keyframe in pixels (robust), all keyframes together.
        outline_scale: Pixels.
        landmarks: Of the mean squared distance of the landmarks from the surface.
        landmarks_scale: Object units.
        smoothness: Of the mean squared Laplacian of the offsets.
    """

    outline: float = 1.0
    outline_scale: float = 2.0
    landmarks: float = 2.0
    landmarks_scale: float = 0.05
    smoothness: float = 300.0


@dataclass(frozen=True, eq=False)
class Views:
    """The keyframes as the shape is fitted to them.

    Attributes:
        R: ``(B, 3, 3)``; t: ``(B, 3)``; K: ``(B, 3, 3)`` of the windows, float32.
        distance: ``(B, S, S)`` signed distance to the mask, pixels of the window.
        weight: ``(B,)`` how far each frame's mask is believed, in [0, 1].
    """

    R: Tensor
    t: Tensor
    K: Tensor
    distance: Tensor
    weight: Tensor


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points that the surface passes through, each seen in one of the views.

    Attributes:
        points: ``(N, 3)`` in object coordinates.
        view: ``(N,)`` int64, a view that shows each.
    """

    points: Tensor
    view: Tensor


def fit_surface(
    vertices: Tensor,
    rest: Tensor,
    faces: Tensor,
    face_uvs: Tensor,
    laplacian: Tensor,
    views: Views,
    landmarks: Landmarks | None = None,
    weights: FitWeights = FitWeights(),
    rounds: int = 3,
    renderer: str = "auto",
) -> Tensor:
    """``(V, 3)`` vertices that fit the views and landmarks better.

    Args:
        vertices: ``(V, 3)`` the shape so far.
        rest: ``(V, 3)`` the prototype, whose offsets are kept smooth.
        faces: ``(F, 3)``; face_uvs: ``(F, 3, 2)``; laplacian: sparse ``(V, V)``.
        views: Keyframes with their poses.
        landmarks: Points of the surface, or None.
        weights: Of the terms.
        rounds: How often contour and attachments are found anew.
        renderer: See `tracking3d.rendering.backend`.
    """
    L = _scipy(laplacian)
    smoothness = (weights.smoothness / len(vertices)) * sparse.kron(L.T @ L, sparse.identity(3), format="csc")
    shape = vertices
    for _ in range(rounds):
        drawn = _drawn(shape, faces, face_uvs, views, renderer)
        rows = [_outline_rows(drawn, views, weights)]
        if landmarks is not None and len(landmarks.points):
            rows.append(_landmark_rows(shape, faces, drawn, views, landmarks, weights))
            rows.append(_uncovered_rows(shape, drawn, views, landmarks, weights))
        offsets = (shape - rest).double().cpu().numpy().ravel()
        matrix, gradient = smoothness, smoothness @ offsets
        for jacobian, residual in rows:
            matrix = matrix + jacobian.T @ jacobian
            gradient = gradient + jacobian.T @ residual
        floor = 1e-6 * matrix.diagonal().max()
        step = splu(
            (matrix + floor * sparse.identity(len(gradient))).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
            diag_pivot_thresh=0.0,
        ).solve(-gradient)
        if not np.isfinite(step).all():
            break
        shape = shape + torch.from_numpy(step.reshape(-1, 3)).to(shape)
    return shape


def _drawn(vertices: Tensor, faces: Tensor, face_uvs: Tensor, views: Views, renderer: str) -> Rendering:
    size = (int(views.distance.shape[1]), int(views.distance.shape[2]))
    nothing = vertices.new_zeros(1, 8, 8)
    return render(vertices, faces, face_uvs, nothing, views.R, views.t, views.K, size, backend=renderer)


def _outline_rows(
    drawn: Rendering, views: Views, weights: FitWeights
) -> tuple[sparse.csr_matrix, FloatArray]:
    """Rows of the weighted outline residuals: Jacobian ``(N, 3 V)`` and residual ``(N,)``."""
    contour = find_contour(drawn)
    residual, slope = contour_slopes(contour, views.distance)
    view = contour.view
    total = residual.new_zeros(contour.frames).index_add(0, view, contour.length).clamp_min(1.0)
    robust = 1 / (1 + (residual / weights.outline_scale).square())
    weight = weights.outline * contour.length / total[view] / contour.frames * robust * views.weight[view]
    root = weight.sqrt()
    by_point = _by_object_point(slope[:, None], contour.points, views, view)[:, 0]  # (N, 3)
    blocks = contour.share[:, :, None] * (root[:, None] * by_point)[:, None]  # (N, 2, 3)
    return _rows(contour.vertices, blocks, drawn.screen.shape[1]), _numpy(root * residual)


def _landmark_rows(
    vertices: Tensor, faces: Tensor, drawn: Rendering, views: Views, landmarks: Landmarks, weights: FitWeights
) -> tuple[sparse.csr_matrix, FloatArray]:
    """Rows of the landmarks' distances from the surface in front of them, along its normal."""
    view = landmarks.view
    x_cam = torch.einsum("nij,nj->ni", views.R[view], landmarks.points) + views.t[view]
    K = views.K[view]
    pixel = (
        x_cam[:, :2] / x_cam[:, 2:].clamp_min(1e-6) * torch.stack([K[:, 0, 0], K[:, 1, 1]], 1) + K[:, :2, 2]
    )
    size = drawn.face_index.shape[1]
    column, row = pixel.round().long().clamp(0, size - 1).unbind(1)
    face = drawn.face_index[view, row, column]
    kept = torch.nonzero(face >= 0)[:, 0]
    face, view = face[kept], view[kept]
    corner = faces[face]
    a, b, c = (drawn.x_cam[view, corner[:, i]] for i in range(3))
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    ray = torch.nn.functional.normalize(x_cam[kept], dim=1)
    slant = (ray * normal).sum(1)
    depth = (a * normal).sum(1) / torch.where(slant.abs() < 0.2, -0.2, slant)
    hit = ray * depth[:, None]
    share = _barycentric(hit, a, b, c)
    distance = ((hit - x_cam[kept]) * normal).sum(1)
    sound = (share.amin(1) > -0.5) & (slant < -0.2) & distance.isfinite()
    robust = 1 / (1 + (distance / weights.landmarks_scale).square())
    root = (
        (weights.landmarks * robust / max(len(landmarks.points), 1)).sqrt() / weights.landmarks_scale * sound
    )
    in_object = torch.einsum("nji,nj->ni", views.R[view], normal)
    blocks = share.clamp(0, 1)[:, :, None] * (root[:, None] * in_object)[:, None]
    return _rows(corner, blocks, len(vertices)), _numpy(torch.where(sound, root * distance, 0.0))


def _uncovered_rows(
    vertices: Tensor, drawn: Rendering, views: Views, landmarks: Landmarks, weights: FitWeights
) -> tuple[sparse.csr_matrix, FloatArray]:
    """Rows of the distances, in all three directions, between landmarks beside the surface and the nearest vertex."""
    _, face = _faces_before(drawn, views, landmarks)
    points = landmarks.points[face < 0]
    nearest = torch.cdist(points, vertices).argmin(1) if len(points) else face.new_zeros(0)
    difference = vertices[nearest] - points
    robust = 1 / (1 + difference.square().sum(1) / (2 * weights.landmarks_scale) ** 2)
    root = (weights.landmarks * robust / max(len(landmarks.points), 1)).sqrt() / weights.landmarks_scale
    blocks = root[:, None, None, None] * torch.eye(3).to(vertices)[None, :, None]  # (N, 3, 1, 3)
    vertex = nearest[:, None].repeat_interleave(3, 0)
    return _rows(vertex, blocks.reshape(-1, 1, 3), len(vertices)), _numpy((root[:, None] * difference).reshape(-1))


def _faces_before(drawn: Rendering, views: Views, landmarks: Landmarks) -> tuple[Tensor, Tensor]:
    """Landmarks in camera coordinates ``(N, 3)``, and the face ``(N,)`` that is seen where each is; -1 for none."""
    view = landmarks.view
    x_cam = torch.einsum("nij,nj->ni", views.R[view], landmarks.points) + views.t[view]
    K = views.K[view]
    pixel = x_cam[:, :2] / x_cam[:, 2:].clamp_min(1e-6) * torch.stack([K[:, 0, 0], K[:, 1, 1]], 1) + K[:, :2, 2]
    size = drawn.face_index.shape[1]
    column, row = pixel.round().long().clamp(0, size - 1).unbind(1)
    return x_cam, drawn.face_index[view, row, column]


def _by_object_point(slope: Tensor, points: Tensor, views: Views, view: Tensor) -> Tensor:
    """``(N, k, 3)`` derivative by the object's points of ``slope (N, k, 2)`` times their pixels."""
    x, y, z = points.unbind(1)
    fx, fy = views.K[view, 0, 0] / z, views.K[view, 1, 1] / z
    zero = torch.zeros_like(z)
    by_point = torch.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], 1).reshape(-1, 2, 3)
    return slope @ by_point @ views.R[view]


def _barycentric(point: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """``(N, 3)`` barycentric coordinates of points in the planes of triangles."""
    u, v, w = b - a, c - a, point - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    determinant = (uu * vv - uv * uv).clamp_min(1e-20)
    second, third = (vv * wu - uv * wv) / determinant, (uu * wv - uv * wu) / determinant
    return torch.stack([1 - second - third, second, third], 1)


def _rows(vertex: Tensor, blocks: Tensor, vertices: int) -> sparse.csr_matrix:
    """Sparse ``(N, 3 V)`` with each row's blocks ``(N, k, 3)`` at its vertices ``(N, k)``."""
    count, corners, _ = blocks.shape
    columns = (3 * vertex[:, :, None] + torch.arange(3)).reshape(count, 3 * corners)
    pointer = np.arange(count + 1) * (3 * corners)
    return sparse.csr_matrix(
        (_numpy(blocks.reshape(-1)), columns.reshape(-1).cpu().numpy(), pointer), shape=(count, 3 * vertices)
    )


def _scipy(matrix: Tensor) -> sparse.csr_matrix:
    matrix = matrix.coalesce()
    rows, columns = matrix.indices().cpu().numpy()
    return sparse.csr_matrix((_numpy(matrix.values()), (rows, columns)), shape=matrix.shape)


def _numpy(values: Tensor) -> FloatArray:
    return values.detach().double().cpu().numpy()
