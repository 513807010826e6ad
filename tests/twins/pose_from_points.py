"""A pose refined by Levenberg-Marquardt over points, all points at once."""

from __future__ import annotations

import numpy as np

from tracking3d.estimation.online.optimization.pnp import _shares
from tracking3d.estimation.online.optimization.types import PNP_DAMPING
from tracking3d.points.bundle_adjustment.reprojection import (
    BEHIND,
    EvaluatedPose,
    FloatArray,
    apply_pose_steps,
    finite_rows,
    project_camera_points,
    transform_to_camera,
)
from twins.reprojection import pixel_by_point, pixel_by_pose


def pose_of_tracks(
    points: FloatArray,
    pixels: FloatArray,
    weight: FloatArray | None,
    K: FloatArray,
    R: FloatArray,
    t: FloatArray,
    scale: float,
    iterations: int = 10,
) -> EvaluatedPose:
    """See `tracking3d.estimation.online.optimization.pnp.pose_of_tracks`."""
    at = point_equations(points, pixels, weight, K, R, t, scale)
    damping = PNP_DAMPING.first
    for _ in range(iterations):
        diagonal = at.matrix.diagonal()
        floor = 1e-9 * diagonal.max() + 1e-12
        step = -np.linalg.solve(at.matrix + np.diag(damping * diagonal + floor), at.gradient)
        R_new, t_new = (
            part[0] for part in apply_pose_steps(at.R[None], at.t[None], np.asarray(step[None], np.float64))
        )
        new = point_equations(points, pixels, weight, K, R_new, t_new, scale)
        if not new.cost < at.cost:
            damping = 10 * damping
            continue
        settled = at.cost - new.cost < PNP_DAMPING.converged * at.cost
        at, damping = new, damping / 10
        if settled:
            break
    return at


def point_equations(
    points: FloatArray,
    pixels: FloatArray,
    weight: FloatArray | None,
    K: FloatArray,
    R: FloatArray,
    t: FloatArray,
    scale: float,
) -> EvaluatedPose:
    """The points' normal equations at a pose; all zero if there is no point. Arguments as of `pose_of_tracks`."""
    share = _shares(points, pixels, weight)
    x_cam = transform_to_camera(R, t, np.where(finite_rows(points)[:, None], points, 0.0))
    difference = project_camera_points(x_cam, K) - pixels
    residual = np.where(share > 0, np.hypot(difference[:, 0], difference[:, 1]), np.nan)
    used = np.isfinite(residual)
    relative = np.where(used, residual / scale, BEHIND)
    cost = float(np.sum(share * np.log1p(relative**2)))
    difference = np.where(used[:, None], difference, 0.0)
    # The Cauchy loss as weights of least squares: its derivative is 2 r / (scale^2 + r^2).
    robust = np.where(used, 2 * share / (scale**2 + np.sum(difference**2, 1)), 0.0)
    motion = pixel_by_pose(pixel_by_point(x_cam, K), x_cam - t)
    rows = motion.reshape(-1, 6)
    weighted = (robust[:, None, None] * motion).reshape(-1, 6)
    return EvaluatedPose(cost, R, t, residual, rows.T @ weighted, weighted.T @ difference.ravel())
