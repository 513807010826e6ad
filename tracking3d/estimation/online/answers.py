"""What the solver answers for a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.correction import MOVING
from tracking3d.estimation.estimate import FrameEstimate, MaskSource, Status
from tracking3d.estimation.online.answer_mask import WeighedMask, answer_mask, learnt
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief
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


def with_colours(state: Belief, answer: FrameEstimate, found: Attempt) -> Belief:
    """The belief with what a frame that is believed shows of the colours."""
    if found.doubtful or found.view.mask is None:
        return state
    return replace(state, colours=learnt(state.colours, found.view.observation, answer.mask))


def solved(
    state: Belief,
    answer: FrameEstimate,
    found: Attempt,
    moving: Callable[[], NDArray[np.float32] | None] | None = None,
) -> FrameEstimate:
    """The answer with a pose, its judgement and the mask that the image shows; of a lost frame, the initial mask.

    Args:
        state: Map, camera and colours.
        answer: What does not depend on the pose.
        found: What was found in the frame.
        moving: See `answer_mask`.
    """
    view, fit, judgement = found.view, found.fit, found.judgement
    if found.lost:
        mask = view.mask if view.mask is not None else np.zeros_like(answer.mask)
        weighed = WeighedMask(mask, MaskSource.handed_back(view.mask))
    else:
        weighed = answer_mask(
            state.known.silhouette(fit.pose, state.camera),
            view.mask,
            view.observation,
            judgement.confidence,
            state.colours,
            moving,
        )
    return replace(
        answer,
        T_cam_obj=fit.pose.matrix().numpy(),
        camera=state.camera,
        mask=weighed.mask,
        mask_source=weighed.source,
        probability=weighed.probability,
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
            MOVING: weighed.moving,
        },
    )
