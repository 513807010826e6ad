"""The shape, given the poses: vertices whose outlines and surface fit the masks and the landmarks.

Gauss-Newton on three terms: the signed distances of the outline in every keyframe, the distances of the landmarks
from the surface that is seen where they are, and the Laplacian of the offsets from the prototype. The normal
equations are sparse; contour and attachments are found again in every round. A landmark beside the silhouette has no
surface behind it and pulls the nearest vertex.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg, splu
from torch import Tensor
from torch.nn import functional

from tracking3d.points.landmark_adjustment import SYMMETRIC
from tracking3d.rendering import Rendering, find_contour, render
from tracking3d.rendering.contour import contour_slopes

FloatArray = NDArray[np.float64]
Rows = tuple[sparse.csr_matrix, FloatArray]
"""Weighted residuals ``(N,)`` and their Jacobian ``(N, 3 V)``, by the vertices' coordinates one after another."""

_GRAZING = 0.2  # cosine between ray and normal below which a face does not constrain a landmark
_BESIDE = 0.5  # how far beside its face, in barycentric coordinates, a landmark may lie
_EXACT, _MOST_STEPS = 1e-10, 20  # share of the target that a solution may miss; steps until then
_FLOOR = 1e-6  # added to the diagonal, as a share of its largest entry


@dataclass(frozen=True)
class FitWeights:
    """The weights of the shape's terms."""

    # weight of the mean squared distance of the outlines from the masks', in pixels, over all keyframes
    outline: float = 1.0
    outline_scale: float = 2.0  # pixels at which an outline's distance counts half (robust)
    # weight of the mean squared distance of the landmarks from the surface, in units of its scale
    landmarks: float = 2.0
    landmarks_scale: float = 0.05  # object units at which a landmark's distance counts half (robust)
    smoothness: float = 300.0  # weight of the mean squared Laplacian of the offsets


@dataclass(frozen=True, eq=False)
class ShapeKeyframes:
    """The keyframes as the shape is fitted to them."""

    R: Tensor  # (B, 3, 3); t: (B, 3); of T_cam_obj
    t: Tensor
    K: Tensor  # (B, 3, 3) of the windows
    distance: Tensor  # (B, S, S) signed distance to the mask, pixels of the window
    weight: Tensor  # (B,) how far each frame's mask is trusted, in [0, 1]


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Points that the surface passes through, each seen in one of the views."""

    points: Tensor  # (N, 3) in object coordinates
    view: Tensor  # (N,) int64, a view that shows each


def fit_surface(
    vertices: Tensor,
    rest: Tensor,
    faces: Tensor,
    face_uvs: Tensor,
    laplacian: Tensor,
    views: ShapeKeyframes,
    landmarks: Landmarks | None = None,
    weights: FitWeights = FitWeights(),
    rounds: int = 3,
    renderer: str = "auto",
) -> Tensor:
    """``(V, 3)`` vertices that fit the views and landmarks better.

    Args:
        vertices: ``(V, 3)`` the shape so far.
        rest: ``(V, 3)`` the prototype, whose offsets are kept smooth.
        faces: ``(F, 3)`` int64.
        face_uvs: ``(F, 3, 2)``.
        laplacian: Sparse ``(V, V)``.
        views: Keyframes with their poses.
        landmarks: Points of the surface, or None.
        weights: The weights of the terms.
        rounds: How often contour and attachments are found again.
        renderer: See `tracking3d.rendering.backend`.
    """
    L = _scipy(laplacian)
    stiffness = (weights.smoothness / len(vertices)) * sparse.kron(L.T @ L, sparse.identity(3), format="csc")
    shape = vertices
    for _ in range(rounds):
        drawn = _draw(shape, faces, face_uvs, views, renderer)
        terms = [_outline_rows(drawn, views, weights)]
        if landmarks is not None:
            x_cam, face = _faces_before(drawn, views, landmarks)
            terms.append(_covered_rows(drawn, x_cam, face, views, landmarks, weights))
            terms.append(_uncovered_rows(shape, landmarks.points, face, weights))
        matrix, gradient = stiffness, stiffness @ _numpy(shape - rest).ravel()
        for jacobian, residual in terms:
            matrix = matrix + jacobian.T @ jacobian
            gradient = gradient + jacobian.T @ residual
        step = _solve(matrix, -gradient)
        if not np.isfinite(step).all():
            break
        shape = shape + torch.from_numpy(step.reshape(-1, 3)).to(shape)
    return shape


def _draw(
    vertices: Tensor, faces: Tensor, face_uvs: Tensor, views: ShapeKeyframes, renderer: str
) -> Rendering:
    """The shape in every view, without a texture."""
    size = (int(views.distance.shape[1]), int(views.distance.shape[2]))
    nothing = vertices.new_zeros(1, 8, 8)
    return render(vertices, faces, face_uvs, nothing, views.R, views.t, views.K, size, backend=renderer)


def _solve(matrix: sparse.spmatrix, target: FloatArray) -> FloatArray:
    """Solution of symmetric positive equations.

    Factorized in single precision, in two thirds of the time; the digits that this loses come back by conjugate
    gradients, in two steps mostly.
    """
    floor = _FLOOR * matrix.diagonal().max()
    damped = (matrix + floor * sparse.identity(len(target))).tocsc()
    factors = splu(damped.astype(np.float32), **SYMMETRIC)
    nearly = LinearOperator(
        damped.shape, lambda rest: factors.solve(rest.astype(np.float32)), dtype=np.float64
    )
    return np.asarray(cg(damped, target, rtol=_EXACT, maxiter=_MOST_STEPS, M=nearly)[0])


def _outline_rows(drawn: Rendering, views: ShapeKeyframes, weights: FitWeights) -> Rows:
    """The outlines' signed distances from the masks'; every frame counts the same but for its weight."""
    contour = find_contour(drawn)
    residual, slope = contour_slopes(contour, views.distance)
    view = contour.view
    total = residual.new_zeros(contour.frames).index_add(0, view, contour.length).clamp_min(1.0)
    share = contour.length / total[view] / contour.frames * views.weight[view]
    root = (weights.outline * share * _robust(residual, weights.outline_scale)).sqrt()
    by_point = (root[:, None] * slope)[:, None] @ _pixel_by_point(contour.points, views, view)  # (N, 1, 3)
    blocks = contour.share[:, :, None] * by_point  # (N, 2, 3)
    return _at_vertices(contour.vertices, blocks, drawn.screen.shape[1]), _numpy(root * residual)


def _covered_rows(
    drawn: Rendering,
    x_cam: Tensor,
    face: Tensor,
    views: ShapeKeyframes,
    landmarks: Landmarks,
    weights: FitWeights,
) -> Rows:
    """The landmarks' distances from the faces ``(N,)`` that are drawn where they are, along the faces' normals."""
    kept = torch.nonzero(face >= 0)[:, 0]
    view, x_cam = landmarks.view[kept], x_cam[kept]
    corner = drawn.faces[face[kept]]
    a, b, c = drawn.x_cam[view[:, None], corner].unbind(1)
    normal = functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    ray = functional.normalize(x_cam, dim=1)
    slant = (ray * normal).sum(1)
    facing = slant < -_GRAZING
    hit = ray * ((a * normal).sum(1) / torch.where(facing, slant, -1.0))[:, None]
    share = _barycentric(hit, a, b, c)
    distance = ((hit - x_cam) * normal).sum(1)
    sound = (share.amin(1) > -_BESIDE) & facing & distance.isfinite()
    root = _landmark_roots(distance, weights.landmarks_scale, len(face), weights) * sound
    in_object = torch.einsum("nji,nj->ni", views.R[view], normal)
    blocks = share.clamp(0, 1)[:, :, None] * (root[:, None] * in_object)[:, None]
    residual = torch.where(sound, root * distance, 0.0)
    return _at_vertices(corner, blocks, drawn.screen.shape[1]), _numpy(residual)


def _uncovered_rows(vertices: Tensor, points: Tensor, face: Tensor, weights: FitWeights) -> Rows:
    """The distances, in all three directions, of landmarks without a face from the nearest vertex."""
    beside = points[face < 0]
    nearest = torch.cdist(beside, vertices).argmin(1)
    difference = vertices[nearest] - beside
    root = _landmark_roots(difference.norm(dim=1), 2 * weights.landmarks_scale, len(points), weights)
    blocks = root[:, None, None] * torch.eye(3).to(vertices)  # (N, 3, 3), a row for each coordinate
    vertex = nearest.repeat_interleave(3)[:, None]
    jacobian = _at_vertices(vertex, blocks.reshape(-1, 1, 3), len(vertices))
    return jacobian, _numpy(root[:, None] * difference).ravel()


def _faces_before(drawn: Rendering, views: ShapeKeyframes, landmarks: Landmarks) -> tuple[Tensor, Tensor]:
    """Landmarks in camera coordinates ``(N, 3)``, and the face ``(N,)`` that is drawn where each is; -1 for none."""
    view = landmarks.view
    x_cam = torch.einsum("nij,nj->ni", views.R[view], landmarks.points) + views.t[view]
    K = views.K[view]
    focal = torch.stack([K[:, 0, 0], K[:, 1, 1]], 1)
    pixel = x_cam[:, :2] / x_cam[:, 2:].clamp_min(1e-6) * focal + K[:, :2, 2]
    _, height, width = drawn.face_index.shape
    column, row = pixel.round().long().unbind(1)
    return x_cam, drawn.face_index[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]


def _robust(residual: Tensor, scale: float) -> Tensor:
    """Weights of the Cauchy loss, 1 at zero and a half at ``scale``."""
    return 1 / (1 + (residual / scale).square())


def _landmark_roots(distance: Tensor, scale: float, count: int, weights: FitWeights) -> Tensor:
    """``(N,)`` factors of the rows of landmarks, ``count`` in all, that are ``distance`` from the surface."""
    mean = weights.landmarks * _robust(distance, scale) / max(count, 1)
    return mean.sqrt() / weights.landmarks_scale


def _pixel_by_point(x_cam: Tensor, views: ShapeKeyframes, view: Tensor) -> Tensor:
    """``(N, 2, 3)`` derivative of pixels by points of the object, given in camera coordinates ``(N, 3)``."""
    x, y, z = x_cam.unbind(1)
    fx, fy = views.K[view, 0, 0] / z, views.K[view, 1, 1] / z
    zero = torch.zeros_like(z)
    by_camera = torch.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], 1).reshape(-1, 2, 3)
    return by_camera @ views.R[view]


def _barycentric(point: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """``(N, 3)`` barycentric coordinates of points in the planes of triangles."""
    u, v, w = b - a, c - a, point - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    determinant = (uu * vv - uv * uv).clamp_min(1e-20)
    second, third = (vv * wu - uv * wv) / determinant, (uu * wv - uv * wu) / determinant
    return torch.stack([1 - second - third, second, third], 1)


def _at_vertices(vertex: Tensor, blocks: Tensor, vertices: int) -> sparse.csr_matrix:
    """Sparse ``(N, 3 V)`` with each row's blocks ``(N, k, 3)`` at its vertices ``(N, k)``."""
    count, corners, _ = blocks.shape
    columns = (3 * vertex[:, :, None] + torch.arange(3, device=vertex.device)).reshape(-1)
    pointer = np.arange(count + 1) * (3 * corners)
    return sparse.csr_matrix(
        (_numpy(blocks.reshape(-1)), columns.cpu().numpy(), pointer), shape=(count, 3 * vertices)
    )


def _scipy(matrix: Tensor) -> sparse.csr_matrix:
    """The same sparse matrix in float64."""
    matrix = matrix.coalesce()
    rows, columns = matrix.indices().cpu().numpy()
    return sparse.csr_matrix((_numpy(matrix.values()), (rows, columns)), shape=matrix.shape)


def _numpy(values: Tensor) -> FloatArray:
    """The same numbers in float64."""
    return np.asarray(values.detach().double().cpu().numpy())
