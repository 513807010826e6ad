"""What the solver answers for a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, Status
from tracking3d.estimation.online.answer_mask import answer_mask, support_beside
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief
from tracking3d.estimation.online.pose_refinement import PoseWeights
from tracking3d.estimation.online.stiffness import least_held
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose

WAITING = "the object has not moved enough yet to tell its shape"


def unsolved(frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose, camera: Camera) -> FrameEstimate:
    """The answer while nothing is known: the initial mask."""
    return FrameEstimate(
        index=frame.index,
        time=frame.time,
        T_cam_obj=pose.matrix().numpy(),
        mask=mask if mask is not None else np.zeros(frame.size, dtype=np.bool_),
        initial_mask=mask,
        status=Status.UNCERTAIN,
        reason=WAITING,
        confidence=0.3,
        mask_source=MaskSource.handed_back(mask),
        camera=camera,
    )


def solved(state: Belief, answer: FrameEstimate, found: Attempt) -> FrameEstimate:
    """The answer with a pose, its judgement and the better supported mask; of a lost frame, the initial mask.

    Args:
        state: Map and camera.
        answer: What does not depend on the pose.
        found: What was found in the frame.
    """
    view, fit, judgement = found.view, found.fit, found.judgement
    if found.lost:
        mask = view.mask if view.mask is not None else np.zeros_like(answer.mask)
        source = MaskSource.handed_back(view.mask)
    else:
        rendered = state.known.silhouette(fit.pose, state.camera)
        # Without texture everything beside the mask looks like the object.
        support = 0.0 if state.known.pointless else 1.0
        if not state.known.pointless and state.surface is not None and view.mask is not None:
            support = support_beside(state.surface, view, fit.pose, PoseWeights().appearance_scale)
        mask, source = answer_mask(rendered, view.mask, support)
    return replace(
        answer,
        T_cam_obj=fit.pose.matrix().numpy(),
        camera=state.camera,
        mask=mask,
        mask_source=source,
        status=judgement.status,
        reason=judgement.reason,
        confidence=judgement.confidence,
        hypothesis=found.won,
        iterations=fit.iterations,
        losses={
            "features": fit.appearance,
            "outline": fit.outline,
            "points": fit.points,
            "overlap": fit.overlap,
            "unseen": fit.unseen,
            "witnesses": float(found.support.witnesses),
            "strays": found.support.strays,
            "stiffness": least_held(fit)[0],
            "mask_weight": view.mask_weight,
        },
    )
