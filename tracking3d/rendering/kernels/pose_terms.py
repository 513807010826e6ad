"""Kernel of `tracking3d.rendering.pose_terms`: a pose is projected, drawn and compared in one pass."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import torch
from numba import boolean, float32, float64, int64, void
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.geometry.camera import NEAR
from tracking3d.rendering.contour import MOST_ON_AN_EDGE, PROBE
from tracking3d.rendering.kernels.compilation import (
    OPTIONS,
    array,
    check_corners,
    kernel,
    record,
    share,
)
from tracking3d.rendering.kernels.normal_equations import (
    COMPARABLE,
    KNOWN,
    SURFACE,
    DrawingBuffers,
    SurfaceArrays,
    TargetArrays,
    finish,
    of_pixels,
    point_motion,
)
from tracking3d.rendering.kernels.visibility import draw_view
from tracking3d.rendering.normal_equations import NormalEquations
from tracking3d.rendering.pose_comparison import MatchedPoints, PoseTarget, PoseTerms, Scales
from tracking3d.rendering.surface import Surface


class MatchArrays(NamedTuple):
    """Points ``(N, 3)`` and where they were found ``(N, 2)``; empty if there are none."""

    points: NDArray[np.float32]
    pixels: NDArray[np.float32]


class LossScales(NamedTuple):
    """Scales of the three losses, and the least depth of matched points."""

    appearance: float
    outline: float
    points: float
    nearest: float


TARGET = record(
    TargetArrays,
    float32[:, :, ::1], float32[:, ::1], boolean[:, ::1], boolean[:, ::1], float32[:, ::1], float32[:, ::1],
)  # fmt: skip
MATCHES = record(MatchArrays, float32[:, ::1], float32[:, ::1])
SCALES = record(LossScales, float64, float64, float64, float64)


def packed(
    surface: Surface, target: PoseTarget, matched: MatchedPoints | None
) -> tuple[SurfaceArrays, TargetArrays, MatchArrays]:
    """The arrays that `terms_of_pose` takes first; what a frame does not have is empty.

    Raises:
        IndexError: If faces name vertices that are not there.
    """
    check_corners(surface.faces, surface.vertices[None])
    none = target.comparable.new_zeros(0, 0)
    mesh = surface.vertices, surface.faces, surface.face_uvs, *surface.edges, surface.layers
    frame = (
        target.features.permute(1, 2, 0),
        target.comparable,
        target.inside,
        none.bool() if target.mask is None else target.mask,
        none if target.distance is None else target.distance,
        target.K,
    )
    points = (none, none) if matched is None else (matched.points, matched.pixels)
    return (
        SurfaceArrays(*map(array, mesh)),
        TargetArrays(*map(array, frame)),
        MatchArrays(*map(array, points)),
    )


@numba.njit(**OPTIONS)
def drawing_buffers(vertices, comparable):
    """Memory for V vertices and a frame's pixels."""
    return DrawingBuffers(
        np.empty_like(vertices),
        np.empty((len(vertices), 2), np.float32),
        np.empty(comparable.shape, np.int64),
        np.empty(comparable.shape, np.float32),
    )


APPEARANCE, OUTLINE, POINTS = range(3)
"""Places of the terms in the sums: each has its matrix, below it its gradient, and in the corner its cost."""
BOTH, EITHER = 2, 3
"""Places of what is counted after those of `of_pixels`: pixels in the silhouette and the mask, and in either."""


def pose_terms(
    surface: Surface,
    target: PoseTarget,
    R: Tensor,
    t: Tensor,
    matched: MatchedPoints | None,
    scales: Scales,
    nearest: float,
) -> PoseTerms:
    """See `tracking3d.rendering.pose_terms`; ``nearest`` is the least depth of matched points."""
    sums, counts = np.zeros((len(R), 3, 7, 7)), np.zeros((len(R), 4))
    losses = LossScales(float(scales.appearance), float(scales.outline), float(scales.points), float(nearest))
    share(_pose_terms, len(R), 2, *packed(surface, target, matched), array(R), array(t), losses, sums, counts)
    models = (
        NormalEquations(term[:, :6, :6], term[:, 6, :6], term[:, 6, 6])
        for term in torch.from_numpy(sums).unbind(1)
    )
    appearance, outline, by_points = models
    counted = torch.from_numpy(counts)
    overlap = counted[:, BOTH] / counted[:, EITHER].clamp_min(1)
    if target.mask is None:
        overlap = torch.ones_like(overlap)
    return PoseTerms(appearance, outline, by_points, counted[:, COMPARABLE], counted[:, KNOWN], overlap)


@kernel(
    void(
        SURFACE, TARGET, MATCHES, float32[:, :, ::1], float32[:, ::1], SCALES, float64[:, :, :, ::1],
        float64[:, ::1], int64, int64,
    )
)  # fmt: skip
def _pose_terms(surface, target, matches, R, t, scales, sums, counts, first, last):
    buffers = drawing_buffers(surface.vertices, target.comparable)
    for pose in range(first, last):
        terms_of_pose(surface, target, matches, R[pose], t[pose], scales, buffers, sums[pose], counts[pose])


@numba.njit(**OPTIONS)
def terms_of_pose(surface, target, matches, R, t, scales, buffers, sums, counts):
    """Add one pose's terms to zeros: ``sums`` ``(3, 7, 7)`` and ``counts`` ``(4,)``, by the places above."""
    x_cam, screen, face_index, inverse_depth = buffers
    _project(surface.vertices, R, t, target.K, np.float32(NEAR), x_cam, screen)
    depth = np.ascontiguousarray(x_cam[:, 2])
    face_index[:] = -1
    inverse_depth[:] = 0
    draw_view(screen, depth, surface.faces, np.float32(NEAR), face_index, inverse_depth)
    of_pixels(surface, target, buffers, depth, t, scales.appearance, sums[APPEARANCE], counts)
    if target.mask.size:
        _count_overlap(face_index, target.inside, target.mask, counts)
    if target.distance.size:
        _of_outline(surface, target, buffers, t, scales.outline, sums[OUTLINE])
    if matches.points.size:
        _of_points(matches, R, t, target.K, scales.points, scales.nearest, sums[POINTS])


@numba.njit(**OPTIONS)
def _project(vertices, R, t, K, near, x_cam, screen):
    for v in range(len(vertices)):
        x, y, z = vertices[v]
        for row in range(3):
            x_cam[v, row] = R[row, 0] * x + R[row, 1] * y + R[row, 2] * z + t[row]
        depth = max(x_cam[v, 2], near)
        screen[v, 0] = x_cam[v, 0] / depth * K[0, 0] + K[0, 2]
        screen[v, 1] = x_cam[v, 1] / depth * K[1, 1] + K[1, 2]


@numba.njit(**OPTIONS)
def _count_overlap(face_index, inside, mask, counts):
    for y in range(len(mask)):
        for x in range(mask.shape[1]):
            if inside[y, x]:
                covered = face_index[y, x] >= 0
                counts[BOTH] += covered and mask[y, x]
                counts[EITHER] += covered or mask[y, x]


@numba.njit(inline="always", **OPTIONS)
def _add(sums, slope_x, slope_y, motion, weight, residual):
    """What a residual with these slopes by the screen's x and y adds: ``weight`` times its square's half."""
    for i in range(6):
        by_i = slope_x * motion[0, i] + slope_y * motion[1, i]
        for j in range(i, 6):
            sums[i, j] += weight * by_i * (slope_x * motion[0, j] + slope_y * motion[1, j])
        sums[6, i] += weight * by_i * residual


@numba.njit(**OPTIONS)
def _of_outline(surface, target, buffers, pivot, scale, sums):
    """Mean loss of the contour's distances; see `tracking3d.rendering.contour`."""
    faces, edges, shared = surface.faces, surface.edges, surface.faces_of_edge
    distance, K = target.distance, target.K
    screen, x_cam, face_index = buffers.screen, buffers.x_cam, buffers.face_index
    height, width = distance.shape
    near, one = np.float32(NEAR), np.float32(1)
    motion = np.zeros((2, 6), np.float32)
    front, fronts = np.zeros(len(faces), np.bool_), np.zeros(len(shared), np.int64)
    for face in range(len(faces)):
        a, b, c = faces[face]
        ab_x, ab_y = screen[b, 0] - screen[a, 0], screen[b, 1] - screen[a, 1]
        ac_x, ac_y = screen[c, 0] - screen[a, 0], screen[c, 1] - screen[a, 1]
        front[face] = (
            ab_y * ac_x > ab_x * ac_y and x_cam[a, 2] > near and x_cam[b, 2] > near and x_cam[c, 2] > near
        )
        if front[face]:
            for side in range(3):
                fronts[edges[face, side]] += 1
    whole = 0.0
    for face in range(len(faces)):
        for side in range(3):
            edge = edges[face, side]
            if not front[face] or (fronts[edge] == shared[edge] and shared[edge] > 1):
                continue
            begin, end = faces[face, side], faces[face, (side + 1) % 3]
            along_x, along_y = screen[end, 0] - screen[begin, 0], screen[end, 1] - screen[begin, 1]
            length = math.sqrt(along_x * along_x + along_y * along_y)
            if not length < np.inf:
                continue
            count = min(max(math.ceil(length), 1), MOST_ON_AN_EDGE)
            across = PROBE / max(length, 1e-12)
            for number in range(count):
                fraction = np.float32((number + 0.5) / count)
                x, y = screen[begin, 0] + fraction * along_x, screen[begin, 1] + fraction * along_y
                column, row = round(x), round(y)
                if not (0 <= column < width and 0 <= row < height):
                    continue
                column, row = round(x - along_y * across), round(y + along_x * across)
                if 0 <= column < width and 0 <= row < height and face_index[row, column] >= 0:
                    continue  # the mesh goes on there
                left = min(max(math.floor(x), 0), max(width - 2, 0))
                top = min(max(math.floor(y), 0), max(height - 2, 0))
                right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
                fx, fy = x - np.float32(left), y - np.float32(top)
                d00, d01 = distance[top, left], distance[top, right]
                d10, d11 = distance[bottom, left], distance[bottom, right]
                twist = d11 - d10 - d01 + d00
                residual = d00 + fx * (d01 - d00) + fy * (d10 - d00) + fx * fy * twist
                # Perspective: on the screen it is the inverse depth that is mixed.
                at_begin, at_end = (one - fraction) / x_cam[begin, 2], fraction / x_cam[end, 2]
                z = one / (at_begin + at_end)
                ray_x = at_begin * x_cam[begin, 0] + at_end * x_cam[end, 0]
                ray_y = at_begin * x_cam[begin, 1] + at_end * x_cam[end, 1]
                point_motion(ray_x, ray_y, z, K[0, 0], K[1, 1], pivot, motion)
                each = length / count
                whole += each
                squared = np.float64(residual) * residual
                weight = each / (scale**2 + squared)
                _add(sums, d01 - d00 + fy * twist, d10 - d00 + fx * twist, motion, weight, residual)
                sums[6, 6] += each * math.log1p(squared / scale**2)
    finish(sums, max(whole, 1.0))


@numba.njit(**OPTIONS)
def _of_points(matches, R, t, K, scale, nearest, sums):
    """Mean loss of the distances between projected points and pixels."""
    points, pixels = matches
    motion = np.zeros((2, 6), np.float32)
    for n in range(len(points)):
        px, py, pz = points[n]
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
        z = max(R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2], np.float32(nearest))
        gap_x = x / z * K[0, 0] + K[0, 2] - pixels[n, 0]
        gap_y = y / z * K[1, 1] + K[1, 2] - pixels[n, 1]
        squared = np.float64(gap_x) ** 2 + np.float64(gap_y) ** 2
        weight = 1 / (scale**2 + squared)
        point_motion(x / z, y / z, z, K[0, 0], K[1, 1], t, motion)
        _add(sums, 1.0, 0.0, motion, weight, gap_x)
        _add(sums, 0.0, 1.0, motion, weight, gap_y)
        sums[6, 6] += math.log1p(squared / scale**2)
    finish(sums, len(points))
