"""Derivatives of the projection of points, all points at once."""

from __future__ import annotations

import numpy as np

from tracking3d.points.bundle_adjustment.reprojection import NEAREST, FloatArray


def pixel_by_point(x_cam: FloatArray, K: FloatArray) -> FloatArray:
    """``(..., 2, 3)`` derivative of the projection; zero for points not in front of the camera."""
    seen = x_cam[..., 2] > NEAREST
    inverse = np.where(seen, 1 / np.where(seen, x_cam[..., 2], 1.0), 0.0)
    derivative = np.zeros((*x_cam.shape[:-1], 2, 3))
    for row in range(2):
        derivative[..., row, row] = K[row, row] * inverse
        derivative[..., row, 2] = -K[row, row] * x_cam[..., row] * inverse**2
    return derivative


def pixel_by_pose(by_point: FloatArray, from_pivot: FloatArray) -> FloatArray:
    """``(..., 2, 6)`` derivative of pixels by (v, w).

    Args:
        by_point: ``(..., 2, 3)`` of `pixel_by_point`.
        from_pivot: ``(..., 3)`` points in camera coordinates less the pivot that rotations turn about.
    """
    # a . (w x y) is w . (y x a).
    y, a = from_pivot[..., None, :], by_point
    turned = np.empty_like(by_point)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        turned[..., i] = y[..., j] * a[..., k] - y[..., k] * a[..., j]
    return np.concatenate([by_point, turned], -1)
