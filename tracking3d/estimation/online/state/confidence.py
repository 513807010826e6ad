"""How far the pose of a frame can be trusted: by the losses that are usual for this object, and by its inliers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Assessment, Status
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.optimization.pose_refinement import TURN, least_constrained_axis
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.frames import TRACKED_CONFIDENCE
from tracking3d.runtime.logistic_model import LogisticModel

ENOUGH_POINTS = 15
"""Inliers that settle a pose, whatever the appearance says."""
_UNSEEN_CHARGE = PoseWeights().unseen
_FULL_WEIGHT_TEXTURE = 0.8  # share of known texture from which the appearance counts in full
_MOSTLY_UNSEEN = 0.7  # share of unseen texture
_MODEL, _FREE_AXIS = LogisticModel.load("pose_confidence"), LogisticModel.load("free_axis_confidence")
_FINISHED = LogisticModel.load("finished_plain_confidence")
# What is rendered counts as four points with a loss of .3 (fitted): without inliers the curvature alone decides
_RENDERED_POINTS, _RENDERED_LOSS = 4, 0.3
_REASONS = {
    "missed": "the silhouette and the mask overlap too little (IoU {fit.overlap:.2f})",
    "unseen_ratio": "much of what is visible has not been seen before (ratio {fit.unseen:.2f})",
    "outlier_ratio": "too many outliers (ratio {evidence.outlier_ratio:.2f})",
    "deviation": "rotation about camera axis ({axis}) is poorly constrained (loss {fit.points:.2f} of the inliers)",
}
_POINTS_ONLY = 0.73  # highest confidence if the points fit and the appearance does not
_OUTLINE_ONLY = 0.5  # highest confidence if only the outline fits
_USUAL_OVERLAP = 0.97  # share of the usual overlap
_WITHOUT_MASK = TRACKED_CONFIDENCE  # highest confidence if there is no mask to compare with
_UNSEEN_ODDS = 1 / 3  # factor of the odds of a pose that few points and hardly any known texture confirm
_MEMORY = 0.9  # of the running means
SETTLED = 15
"""Tracked frames whose means bound those of later ones."""
_WORST_RATIO, _OUTLINE_ROOM, _OVERLAP_ROOM = 1.5, 0.1, 0.05  # how far the means may move from there


@dataclass(frozen=True)
class PoseEvidence:
    """The evidence for a pose apart from its losses."""

    inliers: int  # inliers among the landmarks that at least two keyframes have seen
    outlier_ratio: float = 0.0  # share of such landmarks in the frame that are outliers, in [0, 1]
    mask_weight: float = 1.0  # how far the mask is trusted, in [0, 1]
    has_mask: bool = True  # whether there is one
    untextured: bool = False  # whether the object has no points that could be tracked
    has_texture: bool = False  # whether it has texture nevertheless, whose points were not found again
    # (3,) in object coordinates, of a surface of revolution: rotation about it is not judged; None without one
    free_axis: NDArray[np.float64] | None = None
    # of a finished map without points over other rotations, see `lead_over_rivals`; NaN of other maps
    lead: float = math.nan

    @property
    def is_decisive(self) -> bool:
        """Whether there are so many inliers that the appearance alone does not contradict them."""
        return self.inliers >= ENOUGH_POINTS


@dataclass(frozen=True)
class LossBaseline:
    """Running mean losses of tracked frames, clamped near those of the first `SETTLED` frames.

    Without the clamp a slow drift would raise the baseline and hide itself.
    """

    appearance: float = 0.2  # appearance loss
    outline: float = 0.3  # outline loss
    overlap: float = 0.9  # IoU with the mask
    frames: int = 0  # how many frames are in them
    # the three of them after the first `SETTLED` frames; None until then
    sound: tuple[float, float, float] | None = None

    def update(self, fit: PoseFit) -> LossBaseline:
        """The baseline after one more tracked frame."""
        appearance = _MEMORY * self.appearance + (1 - _MEMORY) * fit.appearance
        outline = _MEMORY * self.outline + (1 - _MEMORY) * fit.outline
        overlap = _MEMORY * self.overlap + (1 - _MEMORY) * fit.overlap
        frames, sound = self.frames + 1, self.sound
        if frames == SETTLED:
            sound = appearance, outline, overlap
        if sound is not None:
            appearance = min(appearance, _WORST_RATIO * sound[0])
            outline = min(outline, _WORST_RATIO * sound[1] + _OUTLINE_ROOM)
            overlap = max(overlap, sound[2] - _OVERLAP_ROOM)
        return LossBaseline(appearance, outline, overlap, frames, sound)


def confidence_features(losses: Mapping[str, float], diagnostics: Mapping[str, float]) -> dict[str, float]:
    """The features of the confidence, by name, from what an estimate records as ``losses`` and ``diagnostics``.

    If the points tell that the mask is wrong, a contradiction with it is no evidence against a pose.
    """
    known, inliers = 1 - diagnostics["unseen_ratio"], diagnostics["inliers"]
    points = inliers + _RENDERED_POINTS
    loss = (inliers * losses["points"] + _RENDERED_POINTS * _RENDERED_LOSS) / points
    # Both residuals of a point share its loss; the curvature is of the mean over the points.
    variance = loss / (2 * points * (diagnostics.get("min_curvature", 0.0) + 1e-3))
    compared = (losses["appearance"] - _UNSEEN_CHARGE * diagnostics["unseen_ratio"]) / max(known, 0.05)
    return {
        "appearance": min(max(compared, 0.0), 2.0),
        "outline": diagnostics["mask_confidence"] * losses["outline"],
        "missed": diagnostics["mask_confidence"] * (1 - diagnostics["mask_iou"]),
        "unseen_ratio": diagnostics["unseen_ratio"],
        "outlier_ratio": diagnostics.get("outlier_ratio", 0.0),
        "lead": diagnostics.get("lead", math.nan),
        # logarithm of the standard deviation in degrees of the rotation about the least constrained axis
        "deviation": math.log(TURN) + math.log(variance) / 2,
    }


def needs_relocalization(fit: PoseFit, baseline: LossBaseline, evidence: PoseEvidence) -> bool:
    """Whether the costly hypotheses of `relocalization` should be tried."""
    if not evidence.is_decisive:
        return loss_excess(fit, baseline, evidence.mask_weight) > 0
    return is_high_loss(fit, baseline, evidence.mask_weight) or fit.points > 1.0


def fits_outline(fit: PoseFit, baseline: LossBaseline) -> bool:
    """Whether a pose fits the outline of its frame as well as is usual, whatever the appearance says.

    An object without texture changes its colours as it turns under a lamp, and there is little else to go by.
    """
    return fit.overlap > _USUAL_OVERLAP * baseline.overlap and fit.outline < baseline.outline + _OUTLINE_ROOM


def loss_excess(fit: PoseFit, baseline: LossBaseline, mask_weight: float) -> float:
    """By how much the losses exceed the baseline: above 0 they are higher, above 1 far higher.

    Texture that was never seen is no evidence against a pose.
    """
    known = 1 - fit.unseen
    compared = (fit.appearance - _UNSEEN_CHARGE * fit.unseen) / max(known, 1e-3)
    appearance = (compared - 1.3 * baseline.appearance - 0.05) / (0.5 * baseline.appearance + 0.1)
    appearance *= min(known / _FULL_WEIGHT_TEXTURE, 1.0)
    outline = mask_weight * (fit.outline - 1.5 * baseline.outline - 0.3) / (baseline.outline + 0.5)
    overlap = mask_weight * (0.85 * baseline.overlap - fit.overlap) / 0.25
    return max(appearance, outline, overlap)


def is_misfit(fit: PoseFit, baseline: LossBaseline) -> bool:
    """Whether a map that explained its first `SETTLED` frames explains a later one worse, as a wrong shape does.

    A surface without points adapts to what contradicts it, and the running means with it.
    """
    if baseline.sound is None:
        return False
    appearance, _, overlap = baseline.sound
    compared = (fit.appearance - _UNSEEN_CHARGE * fit.unseen) / max(1 - fit.unseen, 0.2)
    return compared > 2 * appearance + 0.1 or fit.overlap < overlap - _OVERLAP_ROOM


def likelihood(fit: PoseFit, evidence: PoseEvidence) -> float:
    """The likelihood that a frame is right: a logistic regression on `confidence_features`.

    Right means within 10 degrees and above an IoU of 0.7. Rotation about a free axis does not count.
    history/2026-11-28-confidence-with-points.md has its calibration.
    """
    model = _MODEL if math.isnan(evidence.lead) else _FINISHED
    return (model if evidence.free_axis is None else _FREE_AXIS).probability(_features(fit, evidence))


def _features(fit: PoseFit, evidence: PoseEvidence) -> dict[str, float]:
    return confidence_features(
        {"appearance": fit.appearance, "outline": fit.outline, "points": fit.points},
        {
            "inliers": evidence.inliers,
            "outlier_ratio": evidence.outlier_ratio,
            "min_curvature": least_constrained_axis(fit)[0],
            "unseen_ratio": fit.unseen,
            "mask_iou": fit.overlap,
            "mask_confidence": evidence.mask_weight,
            "lead": evidence.lead,
        },
    )


def is_high_loss(fit: PoseFit, baseline: LossBaseline, mask_weight: float) -> bool:
    """Whether the losses of a pose far exceed the baseline."""
    return loss_excess(fit, baseline, mask_weight) > 1


def assess_pose(
    fit: PoseFit, baseline: LossBaseline, evidence: PoseEvidence, guessed: bool = False, astray: bool = False
) -> Assessment:
    """Status, reason and confidence of one frame.

    Args:
        fit: The pose and its losses.
        baseline: The losses of tracked frames.
        evidence: The evidence for the pose apart from its losses.
        guessed: Whether the pose is the best of many rotations that were tried. If none of them explains the frame, the
            least bad one is chance, and so are the points that happen to fit it.
        astray: Whether the object was lost in the frame before and the pose is not consistent with the motion model.
            Then the frame shows no new side, and the mask may be of another object.
    """
    odd = loss_excess(fit, baseline, evidence.mask_weight)
    far, few = odd > 1, not evidence.is_decisive
    if few and not evidence.has_mask:
        return Assessment(Status.LOST, "the object is out of sight: no mask and too few inliers", 0.05)
    if far and guessed and not few:
        return Assessment(Status.LOST, "no pose hypothesis explains the frame", 0.05)
    confidence = likelihood(fit, evidence)
    by_outline = evidence.untextured and evidence.has_mask and fits_outline(fit, baseline)
    loss = f"appearance loss {fit.appearance:.2f}, usually {baseline.appearance:.2f}"
    if few and far and by_outline:
        reason = f"the outline fits, the appearance does not ({loss})"
        return Assessment(Status.UNCERTAIN, reason, min(confidence, _OUTLINE_ONLY))
    if few and far:
        found = f"{loss}; mask IoU {fit.overlap:.2f}; {evidence.inliers} inliers"
        reason = f"no pose fits the frame ({found})"
        if fits_outline(fit, baseline):
            reason = f"no pose fits the frame, though one fits the mask ({found})"
        return Assessment(Status.LOST, reason, 0.05)
    if not evidence.has_mask:
        confidence = min(confidence, _WITHOUT_MASK)
    if few and fit.unseen > _MOSTLY_UNSEEN:
        confidence = _scale_odds(confidence, _UNSEEN_ODDS)
    if astray and few and confidence < TRACKED_CONFIDENCE:
        status = Status.UNCERTAIN if by_outline and odd <= 0 else Status.LOST
        return Assessment(
            status, "found again after a loss; could be a different object", min(confidence, _OUTLINE_ONLY)
        )
    if far:
        reason = f"the points fit, the appearance does not (loss {fit.appearance:.2f})"
        return Assessment(Status.UNCERTAIN, reason, min(confidence, _POINTS_ONLY))
    if confidence >= TRACKED_CONFIDENCE:
        return Assessment(Status.TRACKED, "", confidence)
    return Assessment(Status.UNCERTAIN, _doubt(fit, evidence), confidence)


def _scale_odds(probability: float, factor: float) -> float:
    """The probability whose odds are ``factor`` times those of ``probability``."""
    return probability * factor / (1 - probability + probability * factor)


def _doubt(fit: PoseFit, evidence: PoseEvidence) -> str:
    """The feature that speaks most against a pose, in words."""
    if not evidence.is_decisive and fit.unseen > _MOSTLY_UNSEEN:
        return "a new side: only the outline and the motion model constrain the pose"
    if evidence.free_axis is not None:
        return _REASONS["missed"].format(fit=fit)
    odds = _MODEL.log_odds(_features(fit, evidence))
    best = {
        name: term.weight * (term.high if term.weight > 0 else term.low)
        for name, term in _MODEL.terms.items()
    }
    worst = max(odds, key=lambda name: best[name] - odds[name])
    if worst == "deviation" and evidence.untextured:
        found = "no points that last" if evidence.has_texture else "hardly any texture"
        return f"the object has {found}: its rotation is poorly constrained"
    if worst == "deviation" and not evidence.is_decisive:
        return f"too few inliers ({evidence.inliers})"
    axis = ", ".join(f"{part:.1f}" for part in least_constrained_axis(fit)[1])
    return _REASONS[worst].format(fit=fit, evidence=evidence, axis=axis)


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """The result of estimating the object's pose in a frame."""

    view: Keyframe  # the frame
    fit: PoseFit  # the pose and its losses
    hypothesis: str  # the name of the winning hypothesis
    points: FollowedPoints  # the pose's inliers
    evidence: PoseEvidence  # the evidence for the pose apart from its losses
    assessment: Assessment  # the pose's assessment

    @property
    def lost(self) -> bool:
        """Whether the pose is rejected."""
        return self.assessment.status is Status.LOST

    @property
    def doubtful(self) -> bool:
        """Whether the object is lost or the confidence is low."""
        return self.assessment.confidence < TRACKED_CONFIDENCE

    def better_than(self, other: PoseCandidate) -> bool:
        """Whether it has more inliers and a lower rendering cost; any pose is better than none."""
        return other.lost or (
            self.evidence.inliers > other.evidence.inliers and self.fit.appearance < other.fit.appearance
        )
