"""Kernels of the module of the same name in `optimization`: what views show of faces, and its normal equations."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float32, float64, int64, types, void
from numpy.typing import NDArray

from tracking3d.points.bundle_adjustment.kernels.reprojection import (
    factorize,
    shared,
    solve_factorised,
)
from tracking3d.rendering.kernels.compilation import kernel, record

_DEPTH_TOLERANCE = 0.05  # of the radius: a face is hidden if something is nearer by more
_GRAZING = 0.1  # faces seen at a smaller cosine are not compared
_LITTLE = 0.05  # share of its best view's weight below which a face is not seen by a view
_ROUNDS = 3  # of the robust means


class Sights(NamedTuple):
    """M times that a view shows a face which two views or more show, C channels; those of a face are neighbours."""

    face: NDArray[np.int64]  # (M,) rising; frame: (M,), the view
    frame: NDArray[np.int64]
    normal: NDArray[np.float64]  # (M, 3) in the camera's axes
    values: NDArray[np.float64]  # (M, 3 C), with the slopes by x and by y
    weight: NDArray[np.float64]  # (M,)
    residual: NDArray[np.float64]  # (M, C); used: (M, C) their weights as in the matrix of the Cauchy loss
    used: NDArray[np.float64]


# What was drawn: x_cam (B, V, 3), screen (B, V, 2), depth (B, S, S), K (B, 3, 3) and faces (F, 3), as in `Rendering`.
_DRAWN = types.Tuple(
    (float32[:, :, ::1], float32[:, :, ::1], float32[:, :, ::1], float32[:, :, ::1], int64[:, ::1])
)
_SIGHTS = record(
    Sights, int64[::1], int64[::1], float64[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1], float64[:, ::1]
)  # fmt: skip
# Where sums are added: place (V,) of each vertex among the V' that are seen; basis (V', M) of the modes there; sums
# (V', 6 M + 3 G + 3), of which 6 M are the blocks' xx, xy, xz, yy, yz and zz times the modes, and the rest those of x,
# y and z with the G unknowns of poses and light, last the gradient; and (G, G + 1) of those, the upper triangle.
_SUMS = types.Tuple((int64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1]))


@kernel(int64(_DRAWN, float32[:, :, :, ::1], float64, _SIGHTS, int64[::1], float64[::1]))
def find_sights(drawn, layers, radius, sights, ends, totals):
    """Write the sights of each face, where each face's end, and the weights of all and of these; how many faces."""
    face_of, view_of, normals, values, weights, _, _ = sights
    x_cam, screen, depth, K, faces = drawn
    size, count = depth.shape[1], layers.shape[3]
    corner, normal, sampled = np.empty((3, 3)), np.empty(3), np.empty(count)
    last, found = 0, 0
    for face in range(len(faces)):
        a, b, c = faces[face]
        first, largest = last, 0.0
        for view in range(len(x_cam)):
            z = (np.float64(x_cam[view, a, 2]) + x_cam[view, b, 2] + x_cam[view, c, 2]) / 3
            _normal_of(x_cam[view], a, b, c, corner, normal)
            x, y = (
                (corner[0, 0] + corner[1, 0] + corner[2, 0]) / 3,
                (corner[0, 1] + corner[1, 1] + corner[2, 1]) / 3,
            )
            cosine = -(normal[0] * x + normal[1] * y + normal[2] * z) / math.sqrt(x * x + y * y + z * z)
            if not cosine > _GRAZING:
                continue
            px, py = K[view, 0, 0] * x / z + K[view, 0, 2], K[view, 1, 1] * y / z + K[view, 1, 2]
            if not (-0.5 <= px <= size - 0.5 and -0.5 <= py <= size - 0.5):
                continue
            front = depth[view, min(max(round(py), 0), size - 1), min(max(round(px), 0), size - 1)]
            if not (0 < front < np.inf and z < front + _DEPTH_TOLERANCE * radius / cosine):
                continue
            ux, uy = screen[view, b, 0] - screen[view, a, 0], screen[view, b, 1] - screen[view, a, 1]
            vx, vy = screen[view, c, 0] - screen[view, a, 0], screen[view, c, 1] - screen[view, a, 1]
            _sample(layers[view], px, py, sampled)
            weight = abs(np.float64(ux) * vy - np.float64(uy) * vx) / 2 * cosine * sampled[count - 1]
            totals[0] += weight
            if weight > 0:
                face_of[last], view_of[last], weights[last] = face, view, weight
                normals[last], values[last] = normal, sampled[: count - 1]
                largest = max(largest, weight)
                last += 1
        seen = 0
        for sight in range(first, last):
            seen += weights[sight] > _LITTLE * largest
        if seen < 2:
            last = first
            continue
        for sight in range(first, last):
            totals[1] += weights[sight]
        found += 1
        ends[found] = last
    return found


@shared
def _normal_of(x_cam, a, b, c, corner, normal):
    """Write a face's corners and normal in the camera's axes; twice its area."""
    for axis in range(3):
        corner[0, axis], corner[1, axis], corner[2, axis] = x_cam[a, axis], x_cam[b, axis], x_cam[c, axis]
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        normal[axis] = (corner[1, i] - corner[0, i]) * (corner[2, j] - corner[0, j]) - (
            corner[1, j] - corner[0, j]
        ) * (corner[2, i] - corner[0, i])
    length = max(math.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2), 1e-12)
    for axis in range(3):
        normal[axis] /= length
    return length


@shared
def _sample(layers, x, y, sampled):
    """Write layers ``(S, S, L)`` at a pixel, bilinear; beyond the border they are zero."""
    size = len(layers)
    left, top = math.floor(x), math.floor(y)
    sampled[:] = 0
    for row in range(top, top + 2):
        for column in range(left, left + 2):
            if 0 <= row < size and 0 <= column < size:
                share = (1 - abs(x - column)) * (1 - abs(y - row))
                for layer in range(len(sampled)):
                    sampled[layer] += share * layers[row, column, layer]


@kernel(float64(_SIGHTS, int64[::1], float64, float64, float64[:, ::1]))
def shade(sights, ends, scale, ridge, light):
    """Write the light, residuals and their weights as in the matrix of the Cauchy loss; the loss."""
    normals, values, used = sights.normal, sights.values, sights.used
    channels = len(light)
    system, side, mean, loss = np.empty((channels, 3, 3)), np.empty((channels, 3)), np.empty(3), 0.0
    for sight in range(len(used)):
        used[sight] = sights.weight[sight]
    for _ in range(_ROUNDS):
        for c in range(channels):
            system[c], side[c] = 0, 0
            for i in range(3):
                system[c, i, i] = ridge
        for face in range(len(ends) - 1):
            for c in range(channels):
                total, value = 1e-20, 0.0
                mean[:] = 0
                for sight in range(ends[face], ends[face + 1]):
                    u = used[sight, c]
                    total += u
                    value += u * values[sight, c]
                    for i in range(3):
                        by = u * normals[sight, i]
                        mean[i] += by
                        side[c, i] += by * values[sight, c]
                        for j in range(i + 1):
                            system[c, i, j] += by * normals[sight, j]
                for i in range(3):
                    side[c, i] -= mean[i] * value / total
                    for j in range(i + 1):
                        system[c, i, j] -= mean[i] * mean[j] / total
        for c in range(channels):
            light[c] = side[c]
            if factorize(system[c]):
                solve_factorised(system[c], light[c])
            else:
                light[c] = 0
        loss = _robust(sights, ends, light, scale)
    return loss


@shared
def _robust(sights, ends, light, scale):
    """Write residuals from the weighted mean, and new weights; the loss of the weights' mean."""
    normals, values, weights, residual, used = (
        sights.normal, sights.values, sights.weight, sights.residual, sights.used
    )  # fmt: skip
    loss = 0.0
    for face in range(len(ends) - 1):
        for c in range(len(light)):
            total, mean = 1e-20, 0.0
            for sight in range(ends[face], ends[face + 1]):
                normal = normals[sight]
                own = values[sight, c] - (
                    normal[0] * light[c, 0] + normal[1] * light[c, 1] + normal[2] * light[c, 2]
                )
                residual[sight, c] = own
                total += used[sight, c]
                mean += used[sight, c] * own
            for sight in range(ends[face], ends[face + 1]):
                residual[sight, c] -= mean / total
        for sight in range(ends[face], ends[face + 1]):
            product = 1.0
            for c in range(len(light)):
                factor = 1 + (residual[sight, c] / scale) ** 2
                used[sight, c] = weights[sight] / factor
                product *= factor
                if product > 1e200:
                    loss += weights[sight] * math.log(product)
                    product = 1.0
            loss += weights[sight] * math.log(product)
    return loss


@kernel(
    void(_DRAWN, _SIGHTS, int64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64, _SUMS)
)
def add_faces(drawn, sights, ends, light, R, t, factor, at_vertices):
    """Add ``factor`` times the residuals' equations; each face's own colour, the weighted mean, is eliminated."""
    faces, rest = drawn[4], at_vertices[3]
    channels, most = len(light), 9 + 6 * len(R)
    # A face's unknowns are its corners' nine and six for each view that sees it; the light's are apart.
    scratch, slopes, own = np.empty((7, 3)), np.empty((channels, 16)), np.empty((15, 16))
    block, lamps, mean = np.empty((most, most)), np.empty((channels, 3, most)), np.empty((channels, most))
    total, tilt, gradient = np.empty(channels), np.empty((channels, 3)), np.empty(9)
    for face in range(len(ends) - 1):
        first, last = ends[face], ends[face + 1]
        width = 9 + 6 * (last - first)
        block[:width, :width], lamps[:], mean[:], total[:], tilt[:], gradient[:] = 0, 0, 0, 0, 0, 0
        for sight in range(first, last):
            at, normal = 9 + 6 * (sight - first), sights.normal[sight]
            _derivatives(drawn, sights, sight, light, R, t, scratch, slopes)
            own[:] = 0
            for c in range(channels):
                slope, u = slopes[c], factor * sights.used[sight, c]
                total[c] += u
                for i in range(15):
                    by = u * slope[i]
                    for j in range(i, 16):
                        own[i, j] += by * slope[j]
                for j in range(9):
                    mean[c, j] += u * slope[j]
                for j in range(6):
                    mean[c, at + j] = u * slope[9 + j]
                for i in range(3):
                    by = u * normal[i]
                    tilt[c, i] += by
                    for j in range(9):
                        lamps[c, i, j] -= by * slope[j]
                    for j in range(6):
                        lamps[c, i, at + j] = -by * slope[9 + j]
                    lamp = rest[rest.shape[0] - 3 * (channels - c) + i]
                    for j in range(i, 3):
                        lamp[rest.shape[0] - 3 * (channels - c) + j] += by * normal[j]
            for i in range(9):
                gradient[i] += own[i, 15]
                for j in range(i, 9):
                    block[i, j] += own[i, j]
                for j in range(6):
                    block[i, at + j] = own[i, 9 + j]
            for i in range(6):
                rest[6 * sights.frame[sight] + i, rest.shape[0]] += own[9 + i, 15]
                for j in range(i, 6):
                    block[at + i, at + j] = own[9 + i, 9 + j]
        for c in range(channels):
            for i in range(width):
                by = mean[c, i] / total[c]
                for j in range(i, width):
                    block[i, j] -= by * mean[c, j]
            for i in range(3):
                by = tilt[c, i] / total[c]
                for j in range(width):
                    lamps[c, i, j] += by * mean[c, j]
                lamp = rest[rest.shape[0] - 3 * (channels - c) + i]
                for j in range(i, 3):
                    lamp[rest.shape[0] - 3 * (channels - c) + j] -= by * tilt[c, j]
        _add_block(faces[sights.face[first]], sights.frame[first:last], block, lamps, gradient, at_vertices)


@shared
def _derivatives(drawn, sights, sight, light, R, t, scratch, slopes):
    """Write those of a view's values, less the light's part, by corners and pose ``(C, 15)``; last the residuals."""
    x_cam, _, _, K, faces = drawn
    view, normal, values = sights.frame[sight], sights.normal[sight], sights.values[sight]
    corner, across, moving, by, turning = scratch[:3], scratch[3], scratch[4], scratch[5], scratch[6]
    a, b, c = faces[sights.face[sight]]
    length = _normal_of(x_cam[view], a, b, c, corner, across)
    middle = (corner[0] + corner[1] + corner[2]) / 3
    channels = len(light)
    for ch in range(channels):
        slope = slopes[ch]
        slope[9:] = 0
        slope[15] = sights.residual[sight, ch]
        _motion(values[channels + ch], values[2 * channels + ch], middle, K[view], moving)
        along = light[ch, 0] * normal[0] + light[ch, 1] * normal[1] + light[ch, 2] * normal[2]
        for i in range(3):
            across[i] = (light[ch, i] - along * normal[i]) / length
        for k in range(3):
            _cross(across, corner[(k + 1) % 3], corner[(k + 2) % 3], turning)
            for i in range(3):
                by[i] = moving[i] / 3 - turning[i]
            _cross(by, corner[k], t[view], turning)
            for i in range(3):
                slope[9 + i] += by[i]
                slope[12 + i] += turning[i]
                slope[3 * k + i] = by[0] * R[view, 0, i] + by[1] * R[view, 1, i] + by[2] * R[view, 2, i]


@shared
def _motion(by_x, by_y, point, K, moving):
    """Write the derivatives by a point in the camera's axes of what has such slopes by the screen's x and y."""
    moving[0], moving[1] = by_x * K[0, 0] / point[2], by_y * K[1, 1] / point[2]
    moving[2] = -(moving[0] * point[0] + moving[1] * point[1]) / point[2]


@shared
def _cross(by, begin, end, product):
    """Write the cross product of ``by`` and the way from ``begin`` to ``end``."""
    for i in range(3):
        p, q = (i + 1) % 3, (i + 2) % 3
        product[i] = by[p] * (end[q] - begin[q]) - by[q] * (end[p] - begin[p])


@shared
def _add_block(corners, frames, block, lamps, gradient, at_vertices):
    """Add a face's equations to the sums; of the block only the upper triangle is given."""
    place, basis, sums, rest = at_vertices
    count, width = basis.shape[1], rest.shape[1]
    p, q, r = basis[place[corners[0]]], basis[place[corners[1]]], basis[place[corners[2]]]
    for i in range(9):
        for j in range(i):
            block[i, j] = block[j, i]
    for k in range(3):
        row, at = sums[place[corners[k]]], 0
        for i in range(3):
            for j in range(i, 3):
                target, by = row[at : at + count], block[3 * k + i]
                first, second, third = by[j], by[3 + j], by[6 + j]
                for mode in range(count):
                    target[mode] += first * p[mode] + second * q[mode] + third * r[mode]
                at += count
        for i in range(3):
            _add_row(row[at : at + width], frames, block[3 * k + i], 0, lamps, 3 * k + i)
            row[at + width - 1] += gradient[3 * k + i]
            at += width
    for number in range(len(frames)):
        for i in range(6):
            line = 9 + 6 * number + i
            _add_row(rest[6 * frames[number] + i], frames, block[line], line, lamps, line)


@shared
def _add_row(row, frames, line, begin, lamps, number):
    """Add to a row what it shares with the poses, from a place of the line on, and with the light."""
    channels = len(lamps)
    for place in range(len(frames)):
        for j in range(max(begin - 9 - 6 * place, 0), 6):
            row[6 * frames[place] + j] += line[9 + 6 * place + j]
    for c in range(channels):
        for j in range(3):
            row[len(row) - 1 - 3 * (channels - c) + j] += lamps[c, j, number]


@kernel(
    void(
        int64[::1], int64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1],
        float32[:, :, ::1], float64[:, :, ::1], float64[:, ::1], _SUMS,
    )
)  # fmt: skip
def add_outlines(frames, vertices, shares, points, slopes, residuals, K, R, t, at_vertices):
    """Add the outlines' equations; ``residuals`` ``(N, 2)`` have their weights beside them."""
    place, basis, sums, rest = at_vertices
    count, width = basis.shape[1], rest.shape[1]
    here, moving, by_point, by_pose = np.empty(count), np.empty(3), np.empty(3), np.empty(6)
    for n in range(len(frames)):
        view, pose, first, second = frames[n], 6 * frames[n], place[vertices[n, 0]], place[vertices[n, 1]]
        _motion(slopes[n, 0], slopes[n, 1], points[n], K[view], moving)
        by_pose[:3] = moving
        _cross(moving, points[n], t[view], by_pose[3:])
        for i in range(3):
            by_point[i] = moving[0] * R[view, 0, i] + moving[1] * R[view, 1, i] + moving[2] * R[view, 2, i]
        for mode in range(count):
            here[mode] = shares[n, 0] * basis[first, mode] + shares[n, 1] * basis[second, mode]
        for k in range(2):
            at, row, weight = 0, sums[second if k else first], residuals[n, 1] * shares[n, k]
            for i in range(3):
                for j in range(i, 3):
                    pull, target = weight * by_point[i] * by_point[j], row[at : at + count]
                    for mode in range(count):
                        target[mode] += pull * here[mode]
                    at += count
            for i in range(3):
                row[at + width - 1] += weight * by_point[i] * residuals[n, 0]
                for j in range(6):
                    row[at + pose + j] += weight * by_point[i] * by_pose[j]
                at += width
        for i in range(6):
            by = residuals[n, 1] * by_pose[i]
            rest[pose + i, width - 1] += by * residuals[n, 0]
            for j in range(i, 6):
                rest[pose + i, pose + j] += by * by_pose[j]
