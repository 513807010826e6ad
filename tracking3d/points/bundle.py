"""Points in space and poses that agree with where points were measured in the images.

Poses and points take turns in Gauss-Newton steps (resection and intersection), with weights of Geman and McClure so
that wrong tracks do not count, and priors that hold both at what the run has found: they go only where the images say
so, and size and place of the whole stay.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.points.view import Array

TURNS = 12
_OUTLIER = 3.0  # deviations at which a measurement has a quarter of its weight


def intersect(
    points: Array,
    intrinsics: Array,
    T_cam_obj: Array,
    measured: Array,
    deviation: Array,
    held: float,
    turns: int = TURNS,
) -> tuple[Array, Array]:
    """Move points to where the views say they are.

    Args:
        points: ``(N, 3)`` in object coordinates.
        intrinsics: ``(T, 4)`` fx, fy, cx, cy of every view.
        T_cam_obj: ``(T, 4, 4)``.
        measured: ``(T, N, 2)`` pixels; NaN where there is none.
        deviation: ``(T, N)`` of them in pixels; infinite where there is none.
        held: Deviation of the points' movement, in object units.

    Returns:
        The points, and the weights ``(T, N)`` that the measurements had in the end: 0 where there is none.
    """
    start, weight = points, np.zeros(deviation.shape)
    for _ in range(turns):
        points, weight = _move_points(points, start, intrinsics, T_cam_obj, measured, deviation, held)
    return points, weight


def bundle(
    points: Array,
    intrinsics: Array,
    T_cam_obj: Array,
    measured: Array,
    deviation: Array,
    held: float,
    held_rotation: float,
    held_translation: float,
    turns: int = TURNS,
) -> tuple[Array, Array, Array]:
    """Move points and poses to where the measurements agree with both.

    Args:
        points, intrinsics, T_cam_obj, measured, deviation, held, turns: See `intersect`.
        held_rotation: Deviation of the poses' rotation in radians.
        held_translation: Deviation of their translation in object units.

    Returns:
        Points, poses ``(T, 4, 4)`` and weights ``(T, N)``.
    """
    start, begun, T = points, T_cam_obj, T_cam_obj.copy()
    prior = np.repeat([1 / held_rotation**2, 1 / held_translation**2], 3)
    weight = np.zeros(deviation.shape)
    for _ in range(turns):
        points, weight = _move_points(points, start, intrinsics, T, measured, deviation, held)
        left, jacobian, weight, seen = _residuals(points, intrinsics, T, measured, deviation)
        arm = seen - T[:, None, :3, 3]
        jacobian = np.concatenate([np.cross(arm[:, :, None, :], jacobian), jacobian], 3)
        weighted = weight[..., None, None] * jacobian
        turned = Rotation.from_matrix(T[:, :3, :3] @ begun[:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        away = np.concatenate([turned, T[:, :3, 3] - begun[:, :3, 3]], 1)
        H = np.einsum("tnij,tnik->tjk", weighted, jacobian) + np.diag(prior)
        b = np.einsum("tnij,tni->tj", weighted, left) - away * prior
        step = np.linalg.solve(H, b[..., None])[..., 0]
        T[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ T[:, :3, :3]
        T[:, :3, 3] += step[:, 3:]
    return points, T, weight


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
    left, jacobian, weight, _ = _residuals(points, intrinsics, T_cam_obj, measured, deviation)
    jacobian = np.einsum("tnij,tjk->tnik", jacobian, T_cam_obj[:, :3, :3])
    weighted = weight[..., None, None] * jacobian
    H = np.einsum("tnij,tnik->njk", weighted, jacobian) + np.eye(3) / held**2
    b = np.einsum("tnij,tni->nj", weighted, left) - (points - start) / held**2
    return points + np.linalg.solve(H, b[..., None])[..., 0], weight


def _residuals(
    points: Array, intrinsics: Array, T_cam_obj: Array, measured: Array, deviation: Array
) -> tuple[Array, Array, Array, Array]:
    """What is left of the measurements ``(T, N, 2)``, how pixels change with the point in camera coordinates ``(T, N,
    2, 3)``, weights ``(T, N)``, and the points in camera coordinates ``(T, N, 3)``.
    """
    seen = points @ T_cam_obj[:, :3, :3].transpose(0, 2, 1) + T_cam_obj[:, None, :3, 3]
    focal, centre = intrinsics[:, None, :2], intrinsics[:, None, 2:]
    ahead = seen[..., 2] > 1e-3
    inverse = 1 / np.where(ahead, seen[..., 2], 1.0)
    xy = focal * seen[..., :2] * inverse[..., None] + centre
    known = ahead & np.isfinite(deviation) & np.isfinite(measured).all(2)
    left = np.where(known[..., None], measured - xy, 0.0)
    jacobian = np.zeros((*seen.shape[:2], 2, 3))
    jacobian[..., 0, 0], jacobian[..., 1, 1] = focal[..., 0] * inverse, focal[..., 1] * inverse
    jacobian[..., 2] = -focal * seen[..., :2] * inverse[..., None] ** 2
    certain = 1 / np.where(known, deviation, 1.0) ** 2
    far = certain * (left**2).sum(2) / _OUTLIER**2
    return left, jacobian, np.where(known, certain / (1 + far) ** 2, 0.0), seen
