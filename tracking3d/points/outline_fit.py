"""Moves the surface along its normals until its silhouettes fit the masks' outlines.

Gauss-Newton, a few steps. Each point of a silhouette's contour should lie where the distance from the mask's outline
is zero, robustly; between the contours, and where no view has one, the displacement is smooth and small.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import spsolve

from tracking3d.geometry.camera import Window
from tracking3d.rendering import find_contour, render
from tracking3d.rendering.contour import contour_slopes
from tracking3d.scene.surface import Drawn, camera_tensors
from tracking3d.scene.view import ObjectView

STEPS = 3
SCALE = 1.5
"""Pixels from which on a disagreement counts less."""
_SMOOTH, _SMALL = 3.0, 0.5
_FARTHEST = 0.02  # of the object's diagonal, in a step


def outline_of(view: Drawn) -> ObjectView:
    """A view with the outline of its mask; a window ends that near to the object only where the frame does."""
    height, width = view.mask.shape
    whole = Window(0, 0, width, width, (height, height))
    return replace(view, window=whole, frame_size=(height, width), mask=view.mask > 0.5)


def fit_to_outlines(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], views: Sequence[ObjectView]
) -> NDArray[np.float64]:
    """``(V, 3)`` the vertices, moved.

    Args:
        vertices: ``(V, 3)`` of a closed mesh.
        faces: ``(F, 3)``.
        views: The frames.
    """
    import trimesh  # slow to import

    smooth = _laplacian(faces, len(vertices))
    hold = _SMOOTH * (smooth.T @ smooth) + _SMALL * identity(len(vertices))
    farthest = _FARTHEST * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    for _ in range(STEPS):
        normals = np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
        equations = [_equations(vertices, faces, normals, view) for view in views]
        if not equations:
            return vertices
        change, ends, residual = (np.concatenate(part) for part in zip(*equations, strict=True))
        if not len(residual):
            return vertices
        starts = np.arange(0, ends.size + 1, 2)
        rows = csr_matrix((change.ravel(), ends.ravel(), starts), (len(residual), len(vertices)))
        weighted = rows.T @ diags(1 / (1 + (residual / SCALE) ** 2))
        matrix, target = weighted @ rows, -(weighted @ residual)
        # In pixels of a view: what a displacement by one pixel costs does not depend on the object's unit.
        unit = max(float(matrix.diagonal().max()), 1e-12)
        moved = spsolve((matrix / unit + hold * (np.mean(matrix.diagonal()) / unit)).tocsc(), target / unit)
        if not np.isfinite(moved).all():
            return vertices
        vertices = vertices + np.clip(moved, -farthest, farthest)[:, None] * normals
    return vertices


def _equations(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    normals: NDArray[np.float64],
    view: ObjectView,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """How the distances of the contour's points change ``(N, 2)`` by displacements of which vertices ``(N, 2)``, and
    what they are ``(N,)``.
    """
    drawn = render(
        torch.from_numpy(vertices).float(), torch.from_numpy(faces), torch.zeros(len(faces), 3, 2),
        torch.zeros(1, 2, 2), *camera_tensors(view), view.window.shape,
    )  # fmt: skip
    contour = find_contour(drawn)
    residual, slope = contour_slopes(contour, torch.from_numpy(-view.signed_distance[None]))
    x, y = contour.position.double().unbind(1)
    left, right, top, bottom = (float(edge) for edge in view.frame_edges)
    # Where the frame ends, so does the mask; the object does not.
    known = (x > left + 2) & (x < right - 2) & (y > top + 2) & (y < bottom - 2)
    points, share, ends = (
        part[known].double().numpy() for part in (contour.points, contour.share, contour.vertices)
    )
    ends = ends.astype(np.int64)
    turned = normals[ends] @ view.T_cam_obj[:3, :3].T  # (N, 2, 3) in camera coordinates
    z = points[:, None, 2:]
    by_screen = (turned[..., :2] - points[:, None, :2] / z * turned[..., 2:]) / z
    by_screen = by_screen * np.diag(view.K)[:2] * share[..., None]
    change = (by_screen * slope[known].double().numpy()[:, None]).sum(2)
    return change, ends, residual[known].double().numpy()


def _laplacian(faces: NDArray[np.int64], vertices: int) -> csr_matrix:
    """``(V, V)``: a value less the mean of its neighbours'."""
    start, end = faces.ravel(), np.roll(faces, -1, 1).ravel()
    adjacent = coo_matrix(
        (np.ones(2 * len(start)), (np.r_[start, end], np.r_[end, start])), (vertices,) * 2
    ).tocsr()
    adjacent.data[:] = 1.0
    degree = np.maximum(np.asarray(adjacent.sum(1)).ravel(), 1.0)
    return identity(vertices) - diags(1 / degree) @ adjacent
