"""A brute-force renderer in float64 numpy that knows nothing of the one under test.

Visibility is ray casting: the ray of pixel (x, y) is ``p = (x, y, 1)``, a vertex seen at ``(sx, sy)`` and depth
z lies at ``(sx z, sy z, z)``, and the ray meets a triangle with corners X where ``[X_0 X_1 X_2] c = p`` has no
negative entry: at barycentrics ``c / sum(c)`` and depth ``1 / sum(c)``. The soft mask is a loop over pixels and
faces, written from the definition of DIB-R's kernel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NEAR = 1e-3


@dataclass(frozen=True, eq=False)
class Picture:
    """One view.

    Attributes:
        face_index: ``(H, W)``, -1 where no face is.
        barycentrics: ``(H, W, 3)`` on the surface, not on the screen.
        depth: ``(H, W)``, infinite where no face is.
    """

    face_index: NDArray[np.int64]
    barycentrics: Array
    depth: Array

    def interpolate(self, attributes: Array) -> Array:
        """``(P, D)`` at the covered pixels, row by row, of ``(F, 3, D)`` values at the faces' corners."""
        covered = self.face_index >= 0
        return np.einsum("pk,pkd->pd", self.barycentrics[covered], attributes[self.face_index[covered]])


def cast_rays(screen: Array, depth: Array, faces: NDArray[np.int64], size: tuple[int, int]) -> Picture:
    """The nearest front-facing face at every pixel of one view.

    Args:
        screen: ``(V, 2)`` pixels.
        depth: ``(V,)``.
        faces: ``(F, 3)``, counter-clockwise seen from outside.
        size: ``(H, W)``.
    """
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    rays = np.stack([x, y, np.ones(size)]).reshape(3, -1)
    points = np.column_stack([screen * depth[:, None], depth])
    face_index = np.full(rays.shape[1], -1)
    inverse_depth = np.zeros(rays.shape[1])
    barycentrics = np.zeros((rays.shape[1], 3))
    for number, face in enumerate(faces):
        corners = points[face].T
        # Its normal times a corner: negative where the camera (at the origin) sees the outside.
        facing = np.linalg.det(corners)
        if depth[face].min() <= NEAR or facing >= 0:
            continue
        c = np.linalg.solve(corners, rays)
        total = c.sum(0)
        closer = (c >= 0).all(0) & (total > inverse_depth)
        face_index[closer], inverse_depth[closer] = number, total[closer]
        barycentrics[closer] = (c[:, closer] / total[closer]).T
    with np.errstate(divide="ignore"):
        depths = (1 / inverse_depth).reshape(size)
    return Picture(face_index.reshape(size), barycentrics.reshape(*size, 3), depths)


def soft_mask(
    screen: Array,
    depth: Array,
    faces: NDArray[np.int64],
    covered: NDArray[np.bool_],
    sigma: float = 7000.0,
    boxlen: float = 0.02,
    knum: int = 30,
) -> Array:
    """DIB-R's soft mask ``(H, W)`` of one view.

    Args:
        screen: ``(V, 2)`` pixels; depth: ``(V,)``; faces: ``(F, 3)``.
        covered: ``(H, W)``.
        sigma, boxlen, knum: The kernel.
    """
    height, width = covered.shape
    ndc = np.column_stack([(2 * screen[:, 0] + 1 - width) / width, (2 * screen[:, 1] + 1 - height) / height])
    mask = np.ones(covered.shape)
    for row, column in np.argwhere(~covered):
        pixel = np.array([(2 * column + 1 - width) / width, (2 * row + 1 - height) / height])
        rest, taken = 1.0, 0
        for face in faces:
            corner = ndc[face]
            low, high = corner.min(0) - boxlen, corner.max(0) + boxlen
            if depth[face].min() <= NEAR or (pixel < low).any() or (pixel >= high).any():
                continue
            if taken == knum:
                break
            taken += 1
            rest *= 1 - np.exp(-sigma * squared_distance(pixel, corner))
        mask[row, column] = 1 - rest
    return mask


def squared_distance(point: Array, corner: Array) -> float:
    """From ``point`` ``(2,)`` to the outline of the triangle ``corner`` ``(3, 2)``: its corners and its edges."""
    best = float(((point - corner) ** 2).sum(1).min())
    for a, b in ((0, 1), (1, 2), (2, 0)):
        along = corner[b] - corner[a]
        length2 = along @ along
        foot = (point - corner[a]) @ along
        if 0 < foot < length2:
            normal = np.array([-along[1], along[0]])
            best = min(best, float((normal @ (point - corner[a])) ** 2 / length2))
    return best
