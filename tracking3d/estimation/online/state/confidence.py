"""How far the pose of a frame is believed: by what is usual for this object, and by what witnesses there are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from tracking3d.estimation.assessment import Assessment
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.optimization.observability import least_constrained_axis
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights

ENOUGH_POINTS = 15
"""Points that agree with a pose and settle it, whatever the pixels say."""
_UNSEEN_CHARGE = PoseWeights().unseen
_ENOUGH_KNOWN = 0.8  # share of known texture from which on it counts in full
_MOSTLY = 0.7  # share of unseen texture
_INTERCEPT = -0.429
_TERMS = {  # weight, and the range that was seen
    "missed": (-6.219, 0.0, 0.5394),
    "unseen": (-3.339, 0.00157, 0.5698),
    "witnesses": (0.4149, 0.0, 5.663),
    "strays": (-0.6459, 0.0, 0.3333),
    "points": (-1.686, 0.0, 0.9385),
    "stiffness": (0.4711, -2.815, 2.374),
}
_REASONS = {
    "missed": "the silhouette overlaps the mask too little (IoU {fit.overlap:.2f})",
    "unseen": "much of the visible surface was never seen before (share {fit.unseen:.2f})",
    "witnesses": "too few point inliers ({evidence.inliers})",
    "strays": "too many point outliers (share {evidence.outlier_ratio:.2f})",
    "points": "the reprojection error of the points is high (loss {fit.points:.2f})",
    "stiffness": "rotation about camera axis ({axis}) is poorly constrained",
}
_DOUBTED = 0.4  # confidence at most where points agree and pixels do not
_BY_OUTLINE = 0.2  # confidence at most where only the outline agrees
_AS_USUAL = 0.97  # of the overlap
_UNWITNESSED = 0.5  # confidence at most where there is no mask to compare with
_MEMORY = 0.9  # of the running means
SETTLED = 15
"""Tracked frames whose means are what later ones are held against."""
_WORSE, _OUTLINE_ROOM, _OVERLAP_ROOM = 1.5, 0.1, 0.05  # how far the means may go from there
BELIEVED = 0.5
"""Confidence from which on a frame is tracked; one of less is looked at twice."""


@dataclass(frozen=True)
class PoseEvidence:
    """What speaks for a pose beside what it costs.

    Attributes:
        witnesses: How many landmarks that two keyframes have seen agree with it.
        strays: Share of such landmarks in the frame that are elsewhere, in [0, 1].
        mask_weight: How far the mask is believed, in [0, 1].
        has_mask: Whether there is one.
        plain: Whether the object has no points that could agree.
    """

    inliers: int
    outlier_ratio: float = 0.0
    mask_weight: float = 1.0
    has_mask: bool = True
    untextured: bool = False

    @property
    def is_decisive(self) -> bool:
        """Whether so many points agree that pixels alone do not contradict them."""
        return self.inliers >= ENOUGH_POINTS


@dataclass(frozen=True)
class LossBaseline:
    """Running mean losses of tracked frames, clamped near those of the first 15.

    So a slow drift cannot raise the baseline.

    Attributes:
        appearance: Appearance loss.
        outline: Outline loss.
        overlap: IoU with the mask.
        frames: How many frames are in them.
        sound: The three of them after the first `SETTLED` frames; None until then.
    """

    appearance: float = 0.2
    outline: float = 0.3
    overlap: float = 0.9
    frames: int = 0
    sound: tuple[float, float, float] | None = None

    def update(self, fit: PoseFit) -> LossBaseline:
        """With one more frame."""
        appearance = _MEMORY * self.appearance + (1 - _MEMORY) * fit.appearance
        outline = _MEMORY * self.outline + (1 - _MEMORY) * fit.outline
        overlap = _MEMORY * self.overlap + (1 - _MEMORY) * fit.overlap
        frames, sound = self.frames + 1, self.sound
        if frames == SETTLED:
            sound = appearance, outline, overlap
        if sound is not None:
            appearance = min(appearance, _WORSE * sound[0])
            outline = min(outline, _WORSE * sound[1] + _OUTLINE_ROOM)
            overlap = max(overlap, sound[2] - _OVERLAP_ROOM)
        return LossBaseline(appearance, outline, overlap, frames, sound)


def confidence_features(losses: Mapping[str, float]) -> dict[str, float]:
    """The evidence that a confidence is made of, by name, from what answers record as ``losses``.

    What contradicts the mask is no evidence against a pose where points tell that the mask is wrong.
    """
    known = 1 - losses["unseen"]
    compared = (losses["features"] - _UNSEEN_CHARGE * losses["unseen"]) / max(known, 0.05)
    return {
        "appearance": min(max(compared, 0.0), 2.0),
        "outline": losses["mask_weight"] * losses["outline"],
        "missed": losses["mask_weight"] * (1 - losses["overlap"]),
        "unseen": losses["unseen"],
        "witnesses": math.log1p(losses["witnesses"]),
        "stiffness": math.log(losses.get("stiffness", 0.0) + 1e-3),
        "strays": losses.get("strays", 0.0),
        "points": losses["points"],
    }


def needs_relocalization(fit: PoseFit, baseline: LossBaseline, evidence: PoseEvidence) -> bool:
    """Whether costly hypotheses should be tried."""
    if not evidence.is_decisive:
        return loss_excess(fit, baseline, evidence.mask_weight) > 0
    return is_high_loss(fit, baseline, evidence.mask_weight) or fit.points > 1.0


def fits_outline(fit: PoseFit, baseline: LossBaseline) -> bool:
    """Whether a pose fits the outline of its frame as well as is usual, whatever the pixels inside say.

    On a plain object that turns under a lamp they change, and there is little else to go by.
    """
    return fit.overlap > _AS_USUAL * baseline.overlap and fit.outline < baseline.outline + _OUTLINE_ROOM


def loss_excess(fit: PoseFit, baseline: LossBaseline, mask_weight: float) -> float:
    """By how much the losses exceed what is usual: above 0 they are higher, above 1 far higher.

    Texture that was never seen is no evidence against a pose.
    """
    known = 1 - fit.unseen
    compared = (fit.appearance - _UNSEEN_CHARGE * fit.unseen) / max(known, 1e-3)
    appearance = (compared - 1.3 * baseline.appearance - 0.05) / (0.5 * baseline.appearance + 0.1)
    appearance *= min(known / _ENOUGH_KNOWN, 1.0)
    outline = mask_weight * (fit.outline - 1.5 * baseline.outline - 0.3) / (baseline.outline + 0.5)
    overlap = mask_weight * (0.85 * baseline.overlap - fit.overlap) / 0.25
    return max(appearance, outline, overlap)


def likelihood(fit: PoseFit, evidence: PoseEvidence) -> float:
    """How likely a frame like this is right: a logistic regression, see `weighed`.

    Right means within 10 degrees and above an IoU of 0.7. Fitted by ``training/confidence.py`` on the causal answers of
    the suite ``fresh`` of seed 9101; docs/method/confidence.md has what it is worth on others.
    """
    return 1 / (1 + math.exp(-_INTERCEPT - sum(_log_odds(fit, evidence).values())))


def _log_odds(fit: PoseFit, evidence: PoseEvidence) -> dict[str, float]:
    """What each kind of evidence adds to the log odds of being right."""
    features = confidence_features(
        {
            "features": fit.appearance,
            "outline": fit.outline,
            "points": fit.points,
            "overlap": fit.overlap,
            "unseen": fit.unseen,
            "witnesses": evidence.inliers,
            "strays": evidence.outlier_ratio,
            "stiffness": least_constrained_axis(fit)[0],
            "mask_weight": evidence.mask_weight,
        }
    )
    return {
        name: weight * min(max(features[name], low), high) for name, (weight, low, high) in _TERMS.items()
    }


def is_high_loss(fit: PoseFit, baseline: LossBaseline, mask_weight: float) -> bool:
    """Whether a pose leaves far more of its frame unexplained than is usual."""
    return loss_excess(fit, baseline, mask_weight) > 1


def assess_pose(
    fit: PoseFit, baseline: LossBaseline, evidence: PoseEvidence, guessed: bool = False, astray: bool = False
) -> Assessment:
    """Status, reason and confidence of one frame.

    Args:
        fit: The pose and its losses.
        usual: What is usual.
        support: What speaks for the pose beside its losses.
        guessed: Whether the pose is the best of many turns that were tried. Where none of them explains the frame,
            which is the least bad is up to chance, and points that happen to agree with it are, too.
        astray: Whether the object was lost in the frame before, and no motion leads to the pose. Then it is no side
            that was never seen, and the mask may be of anything.
    """
    odd = loss_excess(fit, baseline, evidence.mask_weight)
    far, few = odd > 1, not evidence.is_decisive
    if few and not evidence.has_mask:
        return Assessment(Status.LOST, "the object is out of sight: no mask and no points", 0.05)
    if far and guessed and not few:
        return Assessment(Status.LOST, "no pose hypothesis explains the frame", 0.05)
    confidence = likelihood(fit, evidence)
    by_outline = evidence.untextured and evidence.has_mask and fits_outline(fit, baseline)
    if few and far and by_outline:
        reason = f"the outline agrees, the pixels do not (loss {fit.appearance:.2f}, usually {baseline.appearance:.2f})"
        return Assessment(Status.UNCERTAIN, reason, min(confidence, _BY_OUTLINE))
    if few and far:
        pixels = f"neither pixels (loss {fit.appearance:.2f}, usually {baseline.appearance:.2f})"
        mask, points = f"the mask (overlap {fit.overlap:.2f})", f"points ({evidence.inliers})"
        if fits_outline(fit, baseline):
            reason = f"{pixels} nor {points} agree with any pose, although one fits {mask}"
        else:
            reason = f"{pixels}, nor {mask}, nor {points} agree with any pose"
        return Assessment(Status.LOST, reason, 0.05)
    if not evidence.has_mask:
        confidence = min(confidence, _UNWITNESSED)
    if few and fit.unseen > _MOSTLY:
        confidence *= 0.5
    if astray and few and confidence < BELIEVED:
        status = Status.UNCERTAIN if by_outline and odd <= 0 else Status.LOST
        return Assessment(
            status,
            "the object found after tracking was lost may be a different one",
            min(confidence, _BY_OUTLINE),
        )
    if far:
        reason = f"the points agree, the pixels do not (loss {fit.appearance:.2f})"
        return Assessment(Status.UNCERTAIN, reason, min(confidence, _DOUBTED))
    if confidence >= BELIEVED:
        return Assessment(Status.TRACKED, "", confidence)
    return Assessment(Status.UNCERTAIN, _doubt(fit, evidence), confidence)


def _doubt(fit: PoseFit, evidence: PoseEvidence) -> str:
    """What speaks most against a pose, in words."""
    if not evidence.is_decisive and fit.unseen > _MOSTLY:
        return "a side never seen before: only outline and motion constrain the pose"
    odds = _log_odds(fit, evidence)
    best = {name: weight * (high if weight > 0 else low) for name, (weight, low, high) in _TERMS.items()}
    worst = max(odds, key=lambda name: best[name] - odds[name])
    axis = ", ".join(f"{part:.1f}" for part in least_constrained_axis(fit)[1])
    return _REASONS[worst].format(fit=fit, support=evidence, axis=axis)
