"""Reprojection of a posed object's points, and its derivatives by poses and points.

A pose moves by ``d = (v, w)`` in the camera's axes: ``x_cam -> exp(w) (x_cam - t) + t + v``, so ``t`` becomes
``t + v`` and ``R`` becomes ``exp(w) R``. That is the step of `tracking3d.rendering.normal_equations`, with the
object's origin as pivot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]

NEAREST = 1e-6
"""Points at this depth or less have no image."""

BEHIND = 100.0
"""A point that is seen, yet has no image, costs as much as a residual of this many robust scales."""


class EvaluatedPose(NamedTuple):
    """A pose with the model ``cost + gradient d + d matrix d / 2`` of what it costs. A named tuple, for kernels."""

    cost: float
    R: FloatArray  # (3, 3) of T_cam_obj
    t: FloatArray  # (3,)
    details: FloatArray  # (M,) of points their distances in pixels, NaN for those without; of a frame see `PoseFit`
    matrix: FloatArray  # (6, 6), see `tracking3d.rendering.NormalEquations`
    gradient: FloatArray  # (6,)


def finite_rows(rows: FloatArray) -> NDArray[np.bool_]:
    """``(...)`` bool, which of ``(..., D)`` have finite numbers only."""
    return np.logical_and.reduce(np.isfinite(rows), axis=-1)


def transform_to_camera(R: FloatArray, t: FloatArray, points: FloatArray) -> FloatArray:
    """``(..., N, 3)`` points in camera coordinates, from poses ``(..., 3, 3)`` and ``(..., 3)``."""
    return points @ np.swapaxes(R, -1, -2) + t[..., None, :]


def project_camera_points(x_cam: FloatArray, K: FloatArray) -> FloatArray:
    """``(..., 2)`` pixels of points ``(..., 3)`` in camera coordinates; nan for those not in front of the camera."""
    depth = np.where(x_cam[..., 2] > NEAREST, x_cam[..., 2], np.nan)
    focal, centre = np.array([K[0, 0], K[1, 1]]), K[:2, 2]
    return x_cam[..., :2] / depth[..., None] * focal + centre


def apply_pose_steps(R: FloatArray, t: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses ``(F, 3, 3)`` and ``(F, 3)`` after steps ``(F, 6)``."""
    return Rotation.from_rotvec(step[:, 3:]).as_matrix() @ R, t + step[:, :3]
