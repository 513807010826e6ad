"""How a surface is closed where no frame has shown it: no further than the convex hull of what was seen.

The surface of the online map begins as an ellipsoid, and what no frame shows keeps bulging. The convex hull is the
smallest convex body that has everything in it that was seen: of a box whose three faces at one corner were seen it is
five sixths of the box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane
from tracking3d.reconstruction.seen_regions import select_large_regions
from tracking3d.results.mesh_export import find_seen_faces

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
