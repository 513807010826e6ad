"""Initial masks that the user declares right: estimates hand them back as they are."""

from __future__ import annotations

from dataclasses import replace

from tracking3d.estimation.estimate import FrameEstimate, MaskSource


def with_initial_mask(estimate: FrameEstimate) -> FrameEstimate:
    """An estimate with its initial mask as the mask, and so are those that it revises; without one it is unchanged."""
    revised = tuple(with_initial_mask(one) for one in estimate.revised)
    if estimate.initial_mask is None:
        return replace(estimate, revised=revised)
    return replace(
        estimate,
        mask=estimate.initial_mask,
        mask_source=MaskSource.INITIAL,
        probability=None,
        revised=revised,
    )
