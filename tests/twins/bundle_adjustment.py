"""Cost, normal equations and step of a bundle adjustment, by whole arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tracking3d.geometry.levenberg_marquardt import damped
from tracking3d.points.bundle_adjustment.adjustment import AdjustmentProblem, Structure, System
from tracking3d.points.bundle_adjustment.reprojection import (
    BEHIND,
    FloatArray,
    project_camera_points,
    transform_to_camera,
)
from twins.reprojection import pixel_by_point, pixel_by_pose


def step(system: System, damping: float) -> tuple[FloatArray, FloatArray] | None:
    """See `System.step`."""
    poses, points = damped(system.poses, damping), damped(system.points, damping)
    flat = system.coupling.reshape(3 * len(points), len(poses))
    by_points = (np.linalg.inv(points) @ system.coupling).reshape(flat.shape)
    gradient = system.poses_gradient - by_points.T @ system.points_gradient.ravel()
    try:
        factor = np.linalg.cholesky(poses - flat.T @ by_points)
    except np.linalg.LinAlgError:
        return None
    d_poses = np.asarray(-np.linalg.solve(factor.T, np.linalg.solve(factor, gradient)), np.float64)
    right = system.points_gradient + system.coupling @ d_poses
    d_points = np.asarray(-np.linalg.solve(points, right[..., None])[..., 0], np.float64)
    sound = np.isfinite(d_poses).all() and np.isfinite(d_points).all()
    return (d_poses, d_points) if sound else None


def evaluated(problem: AdjustmentProblem, at: Structure) -> Structure:
    """See `AdjustmentProblem.evaluated`."""
    K = problem.intrinsics(at.focal_factor)
    difference = project_camera_points(transform_to_camera(at.R, at.t, at.points), K) - problem.pixels
    distance = np.hypot(difference[..., 0], difference[..., 1])
    residual = np.where(problem.weight > 0, distance, np.nan)
    relative = np.where(np.isfinite(residual), residual / problem.scale, BEHIND)
    total = float(np.sum(problem.weight * np.log1p(relative**2)))
    total += float(np.sum(problem.prior_weight * np.sum((at.points - problem.prior) ** 2, 1)))
    return replace(at, cost=float(total / max(problem.weight.sum(), 1e-12)), residual=residual)


def linearised(problem: AdjustmentProblem, at: Structure) -> System:
    """See `AdjustmentProblem.linearised`."""
    K = problem.intrinsics(at.focal_factor)
    x_cam = transform_to_camera(at.R, at.t, at.points)
    difference = project_camera_points(x_cam, K) - problem.pixels
    used = (problem.weight > 0) & np.isfinite(difference).all(-1)
    difference = np.where(used[..., None], difference, 0.0)
    # The Cauchy loss as weights of least squares: its derivative is 2 r / (scale^2 + r^2).
    root = np.sqrt(2 * np.where(used, problem.weight, 0.0) / (problem.scale**2 + np.sum(difference**2, -1)))
    by_point = root[..., None, None] * pixel_by_point(x_cam, K)
    residual = root[..., None] * difference
    by_pose = pixel_by_pose(by_point, x_cam - at.t[:, None])[problem.fixed :]
    by_point_obj = by_point @ at.R[:, None]
    free, many = len(at.R) - problem.fixed, len(at.points)
    count = 6 * free
    size = count + problem.free_focal
    poses, gradient = np.zeros((size, size)), np.zeros(size)
    coupling = np.zeros((many, 3, size))
    rows = by_pose.reshape(free, 2 * many, 6)
    blocks = rows.transpose(0, 2, 1) @ rows
    for n in range(free):
        poses[6 * n : 6 * n + 6, 6 * n : 6 * n + 6] = blocks[n]
    gradient[:count] = np.einsum(
        "fki,fk->fi", rows, residual[problem.fixed :].reshape(free, 2 * many)
    ).ravel()
    coupling[..., :count] = np.einsum("fnki,fnkj->njfi", by_pose, by_point_obj[problem.fixed :]).reshape(
        many, 3, count
    )
    if problem.free_focal:
        # Depths go with the focal length: to first order the image of the object's origin plane stays.
        pixel = project_camera_points(x_cam, K) - K[:2, 2]
        by_focal = np.where(used[..., None], root[..., None] * pixel, 0.0)
        by_focal += by_point[..., 2] * at.t[:, None, 2:]
        poses[count, count] = np.sum(by_focal**2)
        gradient[count] = np.sum(by_focal * residual)
        border = np.einsum("fnki,fnk->fi", by_pose, by_focal[problem.fixed :]).ravel()
        poses[count, :count] = poses[:count, count] = border
        coupling[..., count] = np.einsum("fnki,fnk->ni", by_point_obj, by_focal)
    points = np.einsum("fnki,fnkj->nij", by_point_obj, by_point_obj)
    points_gradient = np.einsum("fnki,fnk->ni", by_point_obj, residual)
    prior_weight = problem.prior_weight[:, None]
    points += 2 * prior_weight[..., None] * np.eye(3)
    points_gradient += 2 * prior_weight * (at.points - problem.prior)
    return System(poses, points, coupling, gradient, points_gradient)
