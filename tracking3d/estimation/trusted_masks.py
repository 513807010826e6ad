"""Initial masks that the user declares right: estimates hand them back as they are."""

from __future__ import annotations

from dataclasses import replace

from tracking3d.estimation.estimate import FrameEstimate, MaskSource
from tracking3d.estimation.tracker_feedback import MOTION_RATIO


def with_initial_mask(estimate: FrameEstimate) -> FrameEstimate:
    """An estimate whose mask is its initial mask, and so for the estimates that it revises.

    A frame without an initial mask keeps the mask of its estimate.
    """
    revised = tuple(with_initial_mask(one) for one in estimate.revised)
    if estimate.initial_mask is None:
        return replace(estimate, revised=revised)
    return replace(
        estimate,
        mask=estimate.initial_mask,
        mask_source=MaskSource.INITIAL,
        probability=None,
        diagnostics={**estimate.diagnostics, MOTION_RATIO: 0.0},
        revised=revised,
    )
