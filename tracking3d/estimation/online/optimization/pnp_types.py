"""What the pose of matched points is found with and what comes of it, for NumPy and the kernel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.bundle_adjustment.reprojection import FloatArray

FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e9
CONVERGED = 1e-6


@dataclass(frozen=True, eq=False)
class PoseHypothesis:
    """One pose and its inliers.

    Attributes:
        R: ``(3, 3)`` and
        t: ``(3,)`` of ``T_cam_obj``.
        inliers: ``(N,)`` bool, which points are seen within the threshold.
        residual: Root of the inliers' mean squared distance, in pixels.
    """

    R: FloatArray
    t: FloatArray
    inliers: NDArray[np.bool_]
    residual: float

    @property
    def count(self) -> int:
        """The number of inliers."""
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True, eq=False)
class PointEquations:
    """A quadratic model ``cost + gradient d + d matrix d / 2`` of the points' mean Cauchy loss in ``d = (v, w)``.

    As `tracking3d.rendering.NormalEquations`, of one frame, with ``t`` as pivot.
    """

    matrix: FloatArray  # (6, 6)
    gradient: FloatArray  # (6,)
    cost: float  # by weight; a point behind the camera costs a large constant
    residual: FloatArray  # (N,) distance in pixels; nan for points without weight or behind the camera


@dataclass(frozen=True, eq=False)
class PnPFit:
    """A pose refined from an initial pose.

    Attributes:
        R: ``(3, 3)`` and
        t: ``(3,)`` of ``T_cam_obj``.
        equations: The model at this pose.
    """

    R: FloatArray
    t: FloatArray
    equations: PointEquations
