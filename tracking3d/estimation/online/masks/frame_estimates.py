"""The solver's estimate for a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, Status
from tracking3d.estimation.online.masks.mask_agreement import initial_mask_weight
from tracking3d.estimation.online.masks.mask_fusion import FusedMask, fuse_mask, update_colours
from tracking3d.estimation.online.optimization.observability import least_constrained_axis
from tracking3d.estimation.online.state.pose_candidate import PoseCandidate
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.estimation.tracker_feedback import MOTION_RATIO
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose


def initial_estimate(
    frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose, camera: Camera
) -> FrameEstimate:
    """The estimate before the initialization: the initial mask."""
    return FrameEstimate(
        index=frame.index,
        time=frame.time,
        T_cam_obj=pose.matrix().numpy(),
        mask=mask if mask is not None else np.zeros(frame.size, dtype=np.bool_),
        initial_mask=mask,
        status=Status.UNCERTAIN,
        reason="the frames so far do not tell the shape of the object",
        confidence=0.3,
        mask_source=MaskSource.as_initial(mask),
        camera=camera,
    )


def learn_colours(state: SolverState, estimate: FrameEstimate, found: PoseCandidate) -> SolverState:
    """The state with the colour models updated by a reliable frame."""
    if found.doubtful or found.view.mask is None:
        return state
    return replace(state, colours=update_colours(state.colours, found.view.observation, estimate.mask))


def make_estimate(
    state: SolverState,
    estimate: FrameEstimate,
    found: PoseCandidate,
    moving: Callable[[], NDArray[np.float32] | None] | None = None,
) -> FrameEstimate:
    """The estimate from a pose, its assessment and the fused mask; if the object is lost, the initial mask.

    Args:
        state: Map, camera and colours.
        estimate: The fields that do not depend on the pose.
        found: The frame's pose candidate.
        moving: See `fuse_mask`.
    """
    view, fit, assessment = found.view, found.fit, found.assessment
    if found.lost:
        mask = view.mask if view.mask is not None else np.zeros_like(estimate.mask)
        weighed = FusedMask(mask, MaskSource.as_initial(view.mask))
    else:
        silhouette = state.object_map.silhouette(fit.pose, state.camera)
        weighed = fuse_mask(
            silhouette,
            view.mask,
            view.observation,
            assessment.confidence,
            state.colours,
            moving,
            0.0 if view.mask is None else initial_mask_weight(state.mask_agreement, view.mask, silhouette),
        )
    return replace(
        estimate,
        T_cam_obj=fit.pose.matrix().numpy(),
        camera=state.camera,
        mask=weighed.mask,
        mask_source=weighed.source,
        probability=weighed.probability,
        status=assessment.status,
        reason=assessment.reason,
        confidence=assessment.confidence,
        hypothesis=found.hypothesis,
        iterations=fit.iterations,
        losses={"appearance": fit.appearance, "outline": fit.outline, "points": fit.points},
        free_axis=found.evidence.free_axis,
        diagnostics={
            "inliers": float(found.evidence.inliers),
            "outlier_ratio": found.evidence.outlier_ratio,
            "min_curvature": least_constrained_axis(fit)[0],
            "unseen_ratio": fit.unseen,
            "mask_iou": fit.overlap,
            "mask_confidence": view.mask_weight,
            MOTION_RATIO: weighed.moving,
        },
    )
