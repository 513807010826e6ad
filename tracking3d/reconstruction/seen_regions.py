"""What was seen of a surface as whole regions, and colours for the rest, carried over the surface.

At grazing angles views show single texels and miss those between them. Such a face follows its neighbours: whether
it counts as seen is averaged over the surface, so that the border of what was seen is a line and not a spray of specks.
Colours that no view shows are those of a membrane over the surface, fixed where colours are known: they continue what
is next to them on the object, not what happens to lie beside it in the atlas.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve
from scipy.spatial import ConvexHull, QhullError

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane
from tracking3d.reconstruction.plane_sweep import Guide
from tracking3d.results.mesh_export import find_seen_faces
from tracking3d.scene.view import ObjectView

FloatArray = NDArray[np.float32]
_ROUNDS = 6  # of averaging over adjacent faces
_SEEN = 0.5  # share of a region's texels
_SMALLEST = 0.01  # share of what was seen, below which a region is a speck
_TEXELS_AT_ONCE = 1 << 16


def smooth_seen_share(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    share: NDArray[np.float64],
    known: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """The share ``(F,)`` of each face that was seen, averaged over the faces around it, each counting by its area.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        share: ``(F,)`` in [0, 1].
        known: ``(F,)`` faces that have a share, since they have a texel; others take that of the faces around them.
    """
    area = _areas(vertices, faces)
    adjacent = _adjacent_faces(faces)
    weight = area if known is None else area * known
    total = weight * share
    for _ in range(_ROUNDS):
        total, weight = total + adjacent @ total, weight + adjacent @ weight
        share = np.where(weight > 0, total / np.maximum(weight, 1e-300), 0.0)
        total, weight = area * share, area * (weight > 0)
    return share


def select_large_regions(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], seen: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """``(F,)`` the faces that were seen and belong to a region of some size: a speck is rather an error.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        seen: ``(F,)`` whether a face was seen.
    """
    at = np.flatnonzero(seen)
    _, region = connected_components(_adjacent_faces(faces)[at][:, at], directed=False)
    area = np.bincount(region, _areas(vertices, faces)[at])
    large = np.zeros(len(faces), bool)
    large[at] = (area >= _SMALLEST * area.sum())[region]
    return large


def select_seen_texels(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    face: NDArray[np.int64],
    shown: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """``(N,)`` which texels count as seen: all or none of a face.

    Args:
        vertices: ``(V, 3)``; faces: ``(F, 3)``.
        faces: See ``vertices``.
        face: ``(N,)`` the face of each texel on the surface.
        shown: ``(N,)`` whether a view shows it.
    """
    count = np.bincount(face, minlength=len(faces))
    share = np.bincount(face, shown, minlength=len(faces)) / np.maximum(count, 1)
    return np.asarray((smooth_seen_share(vertices, faces, share, count > 0) > _SEEN)[face])


def spread_colours(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    face: NDArray[np.int64],
    barycentric: FloatArray,
    colours: FloatArray,
    shown: NDArray[np.bool_],
) -> FloatArray:
    """Colours of the texels that no view shows, by diffusion over the surface.

    Args:
        vertices: ``(V, 3)``; faces: ``(F, 3)``.
        faces: See ``vertices``.
        face: ``(N,)`` the face of each texel on the surface.
        barycentric: ``(N, 3)`` its place on that face.
        colours: ``(N, 3)``.
        shown: ``(N,)`` whether a view shows it, in at least one place.

    Returns:
        ``(M, 3)`` for the M texels that are not shown, in their order.
    """
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    known = np.flatnonzero(shown)
    for corner in range(3):
        vertex = faces[face[known], corner]
        part = barycentric[known, corner].clip(0, 1).astype(np.float64)
        weight += np.bincount(vertex, part, minlength=len(vertices))
        for channel in range(3):
            total[:, channel] += np.bincount(vertex, part * colours[known, channel], minlength=len(vertices))
    fixed = weight > 1e-6
    values = np.where(fixed[:, None], total / np.maximum(weight, 1e-12)[:, None], 0.0)
    values = _membrane(faces, values, fixed)
    missing = np.flatnonzero(~shown)
    spread = np.empty((len(missing), 3), np.float32)
    for first in range(0, len(missing), _TEXELS_AT_ONCE):
        some = missing[first : first + _TEXELS_AT_ONCE]
        at = values[faces[face[some]]]
        spread[first : first + len(some)] = np.einsum("nk,nkc->nc", barycentric[some], at)
    return spread


def _membrane(
    faces: NDArray[np.int64], values: NDArray[np.float64], fixed: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Values ``(V, 3)`` at vertices that are the mean of their neighbours wherever they are not fixed."""
    if fixed.all():
        return values
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    edges = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(len(values),) * 2).tocsr()
    # A little pull to the mean keeps pieces solvable that touch nothing known.
    mean = values[fixed].mean(0)
    free = np.flatnonzero(~fixed)
    degree = edges.sum(1)
    matrix = (diags_array(degree + 1e-6) - edges).tocsr()
    right = 1e-6 * mean + edges[free][:, fixed] @ values[fixed]
    filled = values.copy()
    filled[free] = spsolve(matrix[free][:, free].tocsc(), right).reshape(-1, 3)
    return filled


def _areas(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Twice the area ``(F,)`` of each face, never 0."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) + 1e-12)


def _adjacent_faces(faces: NDArray[np.int64]) -> csr_array:
    """``(F, F)`` 1 for every edge that two faces share."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(1)
    a, b = owner[order][:-1][same], owner[order][1:][same]
    ones = np.ones(2 * len(a))
    return coo_array((ones, (np.r_[a, b], np.r_[b, a])), shape=(len(faces),) * 2).tocsr()


def seen_vertices(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], views: Sequence[ObjectView]
) -> NDArray[np.bool_]:
    """``(V,)`` whether any of the views shows a vertex.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        views: The frames.
    """
    import trimesh  # slow to import, and only needed at the end

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    tolerance = 0.01 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    seen = np.zeros(len(vertices), np.bool_)
    for view in views:
        drawn, _ = Guide(vertices, faces).visible_to(view)
        x, y, z = view.P[:, :3] @ vertices.T + view.P[:, 3:]
        column, row = np.rint(x / z).astype(int), np.rint(y / z).astype(int)
        inside = (z > 0) & (column >= 0) & (column < len(drawn)) & (row >= 0) & (row < len(drawn))
        eye = -view.T_cam_obj[:3, :3].T @ view.T_cam_obj[:3, 3]
        front = (mesh.vertex_normals * (eye - vertices)).sum(1) > 0
        at = row.clip(0, len(drawn) - 1), column.clip(0, len(drawn) - 1)
        seen |= inside & front & (z < drawn[at] + tolerance)
    return seen


# How a surface is closed where no frame has shown it: no further than the convex hull of what was seen.
#
# The surface of the online map begins as an ellipsoid, and what no frame shows keeps bulging. The convex hull is the
# smallest convex body that has everything in it that was seen: of a box whose three faces at one corner were seen it is
# five sixths of the box.

_LEAST = 12  # seen vertices that a hull is made of


def close_unseen(model: ObjectModel, planes: Sequence[SymmetryPlane] = ()) -> ObjectModel:
    """The model with the vertices that no frame has shown moved into the convex hull of the others.

    They move towards the middle of the hull, until they are on it. Vertices that were seen stay, other than those of
    specks (`select_large_regions`), and so does the whole model if what was seen lies in one plane.

    Args:
        model: The model with the texture that says what was seen.
        planes: Planes of symmetry: the mirror images of what was seen are in the hull, too.
    """
    seen = np.zeros(len(model.vertices), bool)
    seen[model.faces[select_large_regions(model.vertices, model.faces, find_seen_faces(model))]] = True
    if seen.all() or np.count_nonzero(seen) < _LEAST:
        return model
    held = model.vertices[seen]
    for plane in planes:
        held = np.concatenate([held, plane.reflect(held)])
    try:
        hull = ConvexHull(held)
    except QhullError:
        return model
    middle = hull.points[hull.vertices].mean(0)
    vertices = model.vertices.copy()
    vertices[~seen] = pull_into(vertices[~seen], middle, hull.equations)
    return replace(model, vertices=vertices)


def pull_into(
    points: NDArray[np.float64], middle: NDArray[np.float64], planes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points outside a convex body moved onto it, along the lines to a point within.

    Args:
        points: ``(N, 3)``.
        middle: ``(3,)`` within the body.
        planes: ``(M, 4)``, for each of its faces the outward normal and the offset: negative inside.
    """
    room = -(planes[:, :3] @ middle + planes[:, 3])
    outward = (points - middle) @ planes[:, :3].T
    reach = np.where(outward > 0, room / np.maximum(outward, 1e-300), np.inf).min(1)
    return np.asarray(middle + np.minimum(reach, 1.0)[:, None] * (points - middle))
