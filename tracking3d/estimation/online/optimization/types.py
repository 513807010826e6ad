"""What the refinement of a frame's poses works with: weights, limits and results, for NumPy and the kernel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.config.models import OnlineConfig
from tracking3d.geometry.levenberg_marquardt import Damping
from tracking3d.geometry.pose import Pose
from tracking3d.points.bundle_adjustment.reprojection import EvaluatedPose, FloatArray

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

    @staticmethod
    def of(found: EvaluatedPose, pose: Pose, iterations: int) -> PoseFit:
        """What was found, with its pose as the solver has poses."""
        appearance, outline, points, overlap, unseen = found.details.tolist()
        information = torch.from_numpy(found.matrix).to(pose.translation)
        return PoseFit(
            pose, found.cost, appearance, outline, points, overlap, unseen, information, iterations
        )


PNP_DAMPING = Damping(first=1e-4, least=0.0, most=1e9, decrease=10, increase=10, converged=1e-6)


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
