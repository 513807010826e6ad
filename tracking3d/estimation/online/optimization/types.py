"""What the refinement of a frame's poses works with: weights, limits and results, for NumPy and the kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.config.models import OnlineConfig
from tracking3d.geometry.pose import Pose
from tracking3d.points.bundle_adjustment.reprojection import FloatArray
from tracking3d.rendering import NormalEquations

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-6, 1e3
ENOUGH = 1e-4
"""Share of the cost below which a gain ends the search."""
NOTHING_SEEN = 1.0
"""What a pose costs that shows nothing comparable, above one that shows unseen texture only."""


@dataclass(frozen=True)
class PoseWeights:
    """The weights of the cost terms, and the scales of their robust losses."""

    appearance: float = 1.0  # weight of the mean over the covered pixels in the mask and the frame
    appearance_scale: float = 0.25  # difference of features at which the loss is log 2
    outline: float = 0.3  # weight of the mean along the outline
    outline_scale: float = 2.0  # pixels at full working resolution at which the loss is log 2
    points: float = 1.0  # weight of the mean over the matched points
    points_scale: float = 1.0  # pixels at full working resolution at which the loss is log 2
    unseen: float = 0.5  # cost of a covered pixel of unseen texture, in place of its loss

    @staticmethod
    def of(options: OnlineConfig) -> PoseWeights:
        """The weights that the solver's options name."""
        weights = options.weights
        return PoseWeights(weights.appearance, outline=weights.outline, points=weights.points)


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose and how well it explains the frame."""

    pose: Pose  # the pose of the frame
    cost: float  # what was minimized
    # mean Cauchy loss over the covered pixels in the mask and the frame, unseen ones charged
    appearance: float
    outline: float  # mean Cauchy loss of the outline; 0 without a mask
    points: float  # mean Cauchy loss of the matched points; 0 without any
    overlap: float  # IoU of what is covered with the mask, inside the frame; 1 without a mask
    unseen: float  # share of the comparable pixels whose texture was never seen, in [0, 1]
    information: Tensor  # (6, 6) matrix of the normal equations, see `tracking3d.rendering.NormalEquations`
    iterations: int  # evaluations spent


@dataclass(frozen=True, eq=False)
class EvaluatedPoses:
    """B poses with what they cost, see `PoseFit`: float64 arrays, each ``(B, ...)``."""

    R: FloatArray
    t: FloatArray
    cost: FloatArray
    appearance: FloatArray
    outline: FloatArray
    points: FloatArray
    overlap: FloatArray
    unseen: FloatArray
    matrix: FloatArray
    gradient: FloatArray
    spent: NDArray[np.int64]  # evaluations that led to them, int64
    moved: NDArray[np.bool_]  # whether they differ from the initial poses, bool

    def __getitem__(self, places: NDArray[Any]) -> EvaluatedPoses:
        """Some of them."""
        return EvaluatedPoses(*(values[places] for values in vars(self).values()))

    def __setitem__(self, places: NDArray[Any], others: EvaluatedPoses) -> None:
        """Put others in their place."""
        for mine, theirs in zip(vars(self).values(), vars(others).values(), strict=True):
            mine[places] = theirs

    def steps(self, damping: FloatArray) -> FloatArray:
        """``(B, 6)`` of Levenberg-Marquardt, see `tracking3d.rendering.NormalEquations.step`."""
        parts = (torch.from_numpy(part) for part in (self.matrix, self.gradient, self.cost))
        taken: FloatArray = NormalEquations(*parts).step(torch.from_numpy(damping)).numpy()
        return taken

    def fit(self, n: int, pose: Pose, iterations: int) -> PoseFit:
        """One of them."""
        costs = (self.cost, self.appearance, self.outline, self.points, self.overlap, self.unseen)
        cost, appearance, outline, points, overlap, unseen = (float(values[n]) for values in costs)
        information = torch.from_numpy(self.matrix[n]).to(pose.translation)
        return PoseFit(pose, cost, appearance, outline, points, overlap, unseen, information, iterations)


PNP_FIRST_DAMPING, PNP_MOST_DAMPING = 1e-4, 1e9
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
