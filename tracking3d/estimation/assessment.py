"""The solver's assessment of its own estimate for a frame: status, reason in words, confidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tracking3d.estimation.estimate import Status


@dataclass(frozen=True)
class Assessment:
    """A judgement of one frame."""

    status: Status
    reason: str
    confidence: float


def assess(
    appearance: float,
    silhouette: float,
    has_mask: bool,
    tau: float,
    silhouette_limit: float,
    failure: str = "",
) -> Assessment:
    """Judge one frame by its losses (paper section 3.4: failure is an appearance loss not below tau).

    Args:
        appearance: ``L_F`` of the frame.
        silhouette: ``L_S`` of the frame; not looked at without a mask.
        has_mask: Whether there was an initial mask.
        tau: Convergence threshold of the appearance loss.
        silhouette_limit: A silhouette loss above this is doubtful.
        failure: A numerical failure, in words.
    """
    if failure:
        return Assessment(Status.LOST, failure, 0.0)
    if not math.isfinite(appearance) or appearance >= tau:
        return Assessment(
            Status.LOST, f"the appearance loss {appearance:.3f} did not fall below {tau:g}", 0.0
        )
    agreement = max(0.0, 1.0 - silhouette) if has_mask else 0.5
    confidence = agreement * (1.0 - 0.5 * appearance / tau)
    if not has_mask:
        return Assessment(Status.UNCERTAIN, "there was no initial mask to compare with", confidence)
    if silhouette >= silhouette_limit:
        reason = f"the silhouette disagrees with the initial mask (loss {silhouette:.2f})"
        return Assessment(Status.UNCERTAIN, reason, confidence)
    return Assessment(Status.TRACKED, "", confidence)
