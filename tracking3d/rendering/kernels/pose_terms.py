"""Kernel of `tracking3d.rendering.pose_terms`: a pose is projected, drawn and compared in one pass."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import torch
from numba import boolean, float32, float64, int64, types, void
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.geometry.camera import NEAR
from tracking3d.rendering.contour import MOST_ON_AN_EDGE, PROBE
from tracking3d.rendering.kernels.compilation import (
    OPTIONS,
    REORDER,
    array,
    check_corners,
    kernel,
    record,
    share,
)
from tracking3d.rendering.kernels.interpolation import barycentrics, slopes_of_face
from tracking3d.rendering.kernels.texture_losses import bilinear_weights, taps_of, texels_at
from tracking3d.rendering.kernels.visibility import draw_view
from tracking3d.rendering.normal_equations import NormalEquations
from tracking3d.rendering.pose_comparison import MatchedPoints, PoseTarget, PoseTerms, Scales
from tracking3d.rendering.renderer import Rendering
from tracking3d.rendering.surface import Surface

# mypy: disable-error-code="no-untyped-def"


class SurfaceArrays(NamedTuple):
    """An object as `tracking3d.rendering.surface.Surface` has it."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float32]
    edges: NDArray[np.int64]
    faces_of_edge: NDArray[np.int64]
    layers: NDArray[np.float32]


class TargetArrays(NamedTuple):
    """A frame as `PoseTarget` has it, features ``(S, S, C)``; what it does not have is empty."""

    features: NDArray[np.float32]
    comparable: NDArray[np.float32]
    inside: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    distance: NDArray[np.float32]
    K: NDArray[np.float32]


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


class DrawingBuffers(NamedTuple):
    """What `terms_of_pose` writes on its way, to be used again.

    Attributes:
        x_cam: ``(V, 3)`` vertices in the camera, and
        screen: ``(V, 2)`` on the screen.
        face_index: ``(S, S)`` faces, and
        inverse_depth: ``(S, S)`` of what is drawn.
    """

    x_cam: NDArray[np.float32]
    screen: NDArray[np.float32]
    face_index: NDArray[np.int64]
    inverse_depth: NDArray[np.float32]


SURFACE = record(
    SurfaceArrays,
    float32[:, ::1], int64[:, ::1], float32[:, :, ::1], int64[:, ::1], int64[::1], float32[:, :, ::1],
)  # fmt: skip
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
COMPARABLE, KNOWN, BOTH, EITHER = range(4)
"""Places of what is counted: see `PoseTerms`; pixels in the silhouette and the mask, and in either."""


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
    of_pixels = torch.from_numpy(counts)
    overlap = of_pixels[:, BOTH] / of_pixels[:, EITHER].clamp_min(1)
    if target.mask is None:
        overlap = torch.ones_like(overlap)
    return PoseTerms(appearance, outline, by_points, of_pixels[:, COMPARABLE], of_pixels[:, KNOWN], overlap)


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


def equations_of_pixels(
    drawn: Rendering, observed: Tensor, pivot: Tensor, scale: float, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `tracking3d.rendering.pose_normal_equations`; ``observed`` is ``(B, H, W, C)``."""
    check_corners(drawn.faces, drawn.screen)
    shape = drawn.face_index.shape
    comparable = weight.new_zeros(drawn.face_index.numel()).index_copy(0, drawn.pixels, weight).reshape(shape)
    layers = torch.cat([drawn.texture, torch.ones_like(drawn.texture[:1])]).permute(1, 2, 0)
    none = np.empty((0, 0), np.int64)
    surface = SurfaceArrays(
        np.empty((0, 3), np.float32), array(drawn.faces), array(drawn.face_uvs), none, none.reshape(-1),
        array(layers),
    )  # fmt: skip
    views = observed, comparable, drawn.K, drawn.x_cam, drawn.screen, drawn.depth.reciprocal(), pivot
    sums = np.zeros((len(pivot), 7, 7))
    share(
        _equations_of_pixels,
        len(pivot),
        2,
        surface,
        array(drawn.face_index),
        tuple(map(array, views)),
        scale,
        sums,
    )
    found = torch.from_numpy(sums).to(drawn.screen)
    return found[:, :6, :6], found[:, 6, :6], found[:, 6, 6]


_PLANES, _ROWS = float32[:, :, ::1], float32[:, ::1]


@kernel(
    void(
        SURFACE, int64[:, :, ::1], types.Tuple((float32[:, :, :, ::1], *[_PLANES] * 5, _ROWS)), float64,
        float64[:, :, ::1], int64, int64,
    )
)  # fmt: skip
def _equations_of_pixels(surface, face_index, views, scale, sums, first, last):
    observed, comparable, K, x_cam, screen, inverse_depth, pivot = views
    nowhere, counts = np.empty((0, 0), np.bool_), np.zeros(4)
    for view in range(first, last):
        target = TargetArrays(observed[view], comparable[view], nowhere, nowhere, comparable[view], K[view])
        buffers = DrawingBuffers(x_cam[view], screen[view], face_index[view], inverse_depth[view])
        depth = np.ascontiguousarray(x_cam[view, :, 2])
        _of_pixels(surface, target, buffers, depth, pivot[view], scale, sums[view], counts)


@numba.njit(**OPTIONS)
def terms_of_pose(surface, target, matches, R, t, scales, buffers, sums, counts):
    """Add one pose's terms to zeros: ``sums`` ``(3, 7, 7)`` and ``counts`` ``(4,)``, by the places above."""
    x_cam, screen, face_index, inverse_depth = buffers
    _project(surface.vertices, R, t, target.K, np.float32(NEAR), x_cam, screen)
    depth = np.ascontiguousarray(x_cam[:, 2])
    face_index[:] = -1
    inverse_depth[:] = 0
    draw_view(screen, depth, surface.faces, np.float32(NEAR), face_index, inverse_depth)
    _of_pixels(surface, target, buffers, depth, t, scales.appearance, sums[APPEARANCE], counts)
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


@numba.njit(fastmath=REORDER, **OPTIONS)
def _of_pixels(surface, target, buffers, depth, pivot, scale, sums, counts):
    """Mean loss of the features over the covered pixels; see `tracking3d.rendering.normal_equations`."""
    faces, face_uvs, layers = surface.faces, surface.face_uvs, surface.layers
    features, comparable, K = target.features, target.comparable, target.K
    screen, face_index, inverse_depth = buffers.screen, buffers.face_index, buffers.inverse_depth
    height, width, channels = layers.shape[0], layers.shape[1], layers.shape[2] - 1
    rows, columns = face_index.shape
    one = np.float32(1)
    sharpness = np.float32(1 / scale**2)
    fx, cx, fy, cy = K[0, 0], K[0, 2], K[1, 1], K[1, 2]
    motion = np.zeros((2, 6), np.float32)
    total = 0.0
    for y in range(rows):
        x = 0
        while x < columns:
            face = face_index[y, x]
            if face < 0:
                x += 1
                continue
            a, b, c = faces[face]
            place, slope_x, slope_y, inverse = slopes_of_face(screen, depth, a, b, c)
            uv = face_uvs[face]
            while x < columns and face_index[y, x] == face:
                column = x
                x += 1
                counts[COMPARABLE] += comparable[y, column]
                if comparable[y, column] == 0:
                    continue
                wa, wb, wc = barycentrics(place, slope_x, slope_y, np.float32(column), np.float32(y))
                wa, wb, wc = wa * inverse[0], wb * inverse[1], wc * inverse[2]
                s = one / (wa + wb + wc)
                u = (wa * uv[0, 0] + wb * uv[1, 0] + wc * uv[2, 0]) * s
                v = (wa * uv[0, 1] + wb * uv[1, 1] + wc * uv[2, 1]) * s
                taps = taps_of(u, v, height, width)
                w00, w01, w10, w11 = bilinear_weights(taps)
                t00, t01, t10, t11 = texels_at(layers, taps)
                seen = w00 * t00[channels] + w01 * t01[channels] + w10 * t10[channels] + w11 * t11[channels]
                weight = np.float64(seen * comparable[y, column])
                if weight == 0:
                    continue
                total += weight
                ua, va, ub, vb = uv[0, 0] - u, uv[0, 1] - v, uv[1, 0] - u, uv[1, 1] - v
                uc, vc = uv[2, 0] - u, uv[2, 1] - v
                xa, xb, xc = slope_x[0] * inverse[0], slope_x[1] * inverse[1], slope_x[2] * inverse[2]
                ya, yb, yc = slope_y[0] * inverse[0], slope_y[1] * inverse[1], slope_y[2] * inverse[2]
                z = one / inverse_depth[y, column]
                texels_u, texels_v = z * np.float32(width), z * np.float32(height)
                by_x = (xa * ua + xb * ub + xc * uc) * texels_u, (xa * va + xb * vb + xc * vc) * texels_v
                by_y = (ya * ua + yb * ub + yc * uc) * texels_u, (ya * va + yb * vb + yc * vc) * texels_v
                xx, xy, yy, gx, gy, loss = _of_channels(
                    layers, taps, features[y, column], channels, sharpness, by_x, by_y
                )
                ray_x, ray_y = (np.float32(column) - cx) / fx, (np.float32(y) - cy) / fy
                _point_motion(ray_x, ray_y, z, fx, fy, pivot, motion)
                for i in range(6):
                    left_x = weight * (xx * motion[0, i] + xy * motion[1, i])
                    left_y = weight * (xy * motion[0, i] + yy * motion[1, i])
                    for j in range(i, 6):
                        sums[i, j] += left_x * motion[0, j] + left_y * motion[1, j]
                    # At a fixed pixel the rendered image moves against the surface.
                    sums[6, i] -= weight * (gx * motion[0, i] + gy * motion[1, i])
                sums[6, 6] += weight * loss
    counts[KNOWN] = total
    _finish(sums, max(total, 1.0) * channels)


@numba.njit(inline="always", **OPTIONS)
def _of_channels(texture, taps, target, channels, sharpness, by_x, by_y):
    """Terms of one pixel, summed over the channels: the 2 x 2 matrix, the two slopes of half the loss, and the loss.

    ``by_x`` and ``by_y`` are the derivatives of the place in the texture, in texels, by the pixel's x and y.
    """
    one = np.float32(1)
    _, _, _, _, fx, fy, free = taps
    w00, w01, w10, w11 = bilinear_weights(taps)
    t00, t01, t10, t11 = texels_at(texture, taps)
    down = one if free else np.float32(0)
    xx = xy = yy = x = y = np.float32(0)
    loss, product = 0.0, 1.0
    for c in range(channels):
        d = w00 * t00[c] + w01 * t01[c] + w10 * t10[c] + w11 * t11[c] - target[c]
        along_u = (one - fy) * (t01[c] - t00[c]) + fy * (t11[c] - t10[c])
        along_v = down * ((one - fx) * (t10[c] - t00[c]) + fx * (t11[c] - t01[c]))
        gx = along_u * by_x[0] + along_v * by_x[1]
        gy = along_u * by_y[0] + along_v * by_y[1]
        factor = one + d * d * sharpness
        robust = sharpness / factor
        xx += robust * gx * gx
        xy += robust * gx * gy
        yy += robust * gy * gy
        x += robust * gx * d
        y += robust * gy * d
        product *= np.float64(factor)
        if product > 1e200:
            loss += math.log(product)
            product = 1.0
    return xx, xy, yy, x, y, loss + math.log(product)


@numba.njit(inline="always", **OPTIONS)
def _point_motion(ray_x, ray_y, z, fx, fy, pivot, motion):
    """Motion on the screen ``(2, 6)`` by (v, w) of the surface point at ``z`` times ``(ray_x, ray_y, 1)``."""
    px, py, pz = ray_x * z - pivot[0], ray_y * z - pivot[1], z - pivot[2]
    sx, sy = fx / z, fy / z
    motion[0, 0], motion[0, 2] = sx, -sx * ray_x
    motion[1, 1], motion[1, 2] = sy, -sy * ray_y
    motion[0, 3], motion[0, 4], motion[0, 5] = -sx * ray_x * py, sx * (pz + ray_x * px), -sx * py
    motion[1, 3], motion[1, 4], motion[1, 5] = -sy * (pz + ray_y * py), sy * ray_y * px, sy * px


@numba.njit(**OPTIONS)
def _finish(sums, total):
    """Means of sums: the upper triangle and the gradient are halves of what they stand for."""
    for i in range(6):
        sums[6, i] *= 2 / total
        for j in range(i, 6):
            sums[i, j] *= 2 / total
            sums[j, i] = sums[i, j]
    sums[6, 6] /= total


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
                _point_motion(ray_x, ray_y, z, K[0, 0], K[1, 1], pivot, motion)
                each = length / count
                whole += each
                squared = np.float64(residual) * residual
                weight = each / (scale**2 + squared)
                _add(sums, d01 - d00 + fy * twist, d10 - d00 + fx * twist, motion, weight, residual)
                sums[6, 6] += each * math.log1p(squared / scale**2)
    _finish(sums, max(whole, 1.0))


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
        _point_motion(x / z, y / z, z, K[0, 0], K[1, 1], t, motion)
        _add(sums, 1.0, 0.0, motion, weight, gap_x)
        _add(sums, 0.0, 1.0, motion, weight, gap_y)
        sums[6, 6] += math.log1p(squared / scale**2)
    _finish(sums, len(points))
