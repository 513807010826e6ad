"""Points moved to where views see them, all points at once."""

from __future__ import annotations

import numpy as np

from tracking3d.points.robust_bundle import _AHEAD, _OUTLIER, TURNS
from tracking3d.scene.view import Array


def intersect(
    points: Array,
    intrinsics: Array,
    T_cam_obj: Array,
    measured: Array,
    deviation: Array,
    held: float,
    turns: int = TURNS,
) -> tuple[Array, Array]:
    """See `tracking3d.points.robust_bundle.intersect`."""
    start, weight = points, np.zeros(deviation.shape)
    for _ in range(turns):
        points, weight = _move_points(points, start, intrinsics, T_cam_obj, measured, deviation, held)
    return points, weight


def _move_points(
    points: Array,
    start: Array,
    intrinsics: Array,
    T_cam_obj: Array,
    measured: Array,
    deviation: Array,
    held: float,
) -> tuple[Array, Array]:
    """One step of all points, and the weights that it was made with."""
    left, jacobian, weight = _residuals(points, intrinsics, T_cam_obj, measured, deviation)
    jacobian = np.einsum("tnij,tjk->tnik", jacobian, T_cam_obj[:, :3, :3])
    weighted = weight[..., None, None] * jacobian
    H = np.einsum("tnij,tnik->njk", weighted, jacobian) + np.eye(3) / held**2
    b = np.einsum("tnij,tni->nj", weighted, left) - (points - start) / held**2
    return points + np.linalg.solve(H, b[..., None])[..., 0], weight


def _residuals(
    points: Array, intrinsics: Array, T_cam_obj: Array, measured: Array, deviation: Array
) -> tuple[Array, Array, Array]:
    """Residuals of the measurements ``(T, N, 2)``, derivatives of pixels by the point in camera coordinates ``(T, N, 2,
    3)``, and weights ``(T, N)``.
    """
    seen = points @ T_cam_obj[:, :3, :3].transpose(0, 2, 1) + T_cam_obj[:, None, :3, 3]
    focal, centre = intrinsics[:, None, :2], intrinsics[:, None, 2:]
    ahead = seen[..., 2] > _AHEAD
    inverse = 1 / np.where(ahead, seen[..., 2], 1.0)
    xy = focal * seen[..., :2] * inverse[..., None] + centre
    known = ahead & np.isfinite(deviation) & np.isfinite(measured).all(2)
    left = np.where(known[..., None], measured - xy, 0.0)
    jacobian = np.zeros((*seen.shape[:2], 2, 3))
    jacobian[..., 0, 0], jacobian[..., 1, 1] = focal[..., 0] * inverse, focal[..., 1] * inverse
    jacobian[..., 2] = -focal * seen[..., :2] * inverse[..., None] ** 2
    certain = 1 / np.where(known, deviation, 1.0) ** 2
    far = certain * (left**2).sum(2) / _OUTLIER**2
    return left, jacobian, np.where(known, certain / (1 + far) ** 2, 0.0)
