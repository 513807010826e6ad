"""How far the pose of a frame is believed: by what is usual for this object, and by what witnesses there are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from tracking3d.estimation.assessment import Assessment
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.pose_refinement_types import PoseFit, PoseWeights
from tracking3d.estimation.online.stiffness import least_held

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
    "missed": "the pose and the mask overlap too little ({fit.overlap:.2f})",
    "unseen": "much of what is seen was never seen before (share {fit.unseen:.2f})",
    "witnesses": "too few points agree ({support.witnesses})",
    "strays": "too many points are elsewhere (share {support.strays:.2f})",
    "points": "the points agree too loosely (loss {fit.points:.2f})",
    "stiffness": "hardly anything holds the object against turning about the camera's axis ({axis})",
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
class Support:
    """What speaks for a pose beside what it costs.

    Attributes:
        witnesses: How many landmarks that two keyframes have seen agree with it.
        strays: Share of such landmarks in the frame that are elsewhere, in [0, 1].
        mask_weight: How far the mask is believed, in [0, 1].
        has_mask: Whether there is one.
        plain: Whether the object has no points that could agree.
    """

    witnesses: int
    strays: float = 0.0
    mask_weight: float = 1.0
    has_mask: bool = True
    plain: bool = False

    @property
    def settles(self) -> bool:
        """Whether so many points agree that pixels alone do not contradict them."""
        return self.witnesses >= ENOUGH_POINTS


@dataclass(frozen=True)
class Usual:
    """What frames that were tracked have cost so far: running means, which stay near those of the first sound frames.

    What follows a decay does not notice it.

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

    def updated(self, fit: PoseFit) -> Usual:
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
        return Usual(appearance, outline, overlap, frames, sound)


def weighed(losses: Mapping[str, float]) -> dict[str, float]:
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


def looks_wrong(fit: PoseFit, usual: Usual, support: Support) -> bool:
    """Whether costly hypotheses should be tried."""
    if not support.settles:
        return unusual(fit, usual, support.mask_weight) > 0
    return unexplained(fit, usual, support.mask_weight) or fit.points > 1.0


def fits_outline(fit: PoseFit, usual: Usual) -> bool:
    """Whether a pose fits the outline of its frame as well as is usual, whatever the pixels inside say.

    On a plain object that turns under a lamp they change, and there is little else to go by.
    """
    return fit.overlap > _AS_USUAL * usual.overlap and fit.outline < usual.outline + _OUTLINE_ROOM


def unusual(fit: PoseFit, usual: Usual, mask_weight: float) -> float:
    """By how much the losses exceed what is usual: above 0 they are higher, above 1 far higher.

    Texture that was never seen is no evidence against a pose.
    """
    known = 1 - fit.unseen
    compared = (fit.appearance - _UNSEEN_CHARGE * fit.unseen) / max(known, 1e-3)
    appearance = (compared - 1.3 * usual.appearance - 0.05) / (0.5 * usual.appearance + 0.1)
    appearance *= min(known / _ENOUGH_KNOWN, 1.0)
    outline = mask_weight * (fit.outline - 1.5 * usual.outline - 0.3) / (usual.outline + 0.5)
    overlap = mask_weight * (0.85 * usual.overlap - fit.overlap) / 0.25
    return max(appearance, outline, overlap)


def likelihood(fit: PoseFit, support: Support) -> float:
    """How likely a frame like this is right: a logistic regression, see `weighed`.

    Right means within 10 degrees and above an IoU of 0.7. Fitted by ``training/confidence.py`` on the causal answers of
    the suite ``fresh`` of seed 9101; docs/method/confidence.md has what it is worth on others.
    """
    return 1 / (1 + math.exp(-_INTERCEPT - sum(_odds(fit, support).values())))


def _odds(fit: PoseFit, support: Support) -> dict[str, float]:
    """What each kind of evidence adds to the log odds of being right."""
    evidence = weighed(
        {
            "features": fit.appearance,
            "outline": fit.outline,
            "points": fit.points,
            "overlap": fit.overlap,
            "unseen": fit.unseen,
            "witnesses": support.witnesses,
            "strays": support.strays,
            "stiffness": least_held(fit)[0],
            "mask_weight": support.mask_weight,
        }
    )
    return {
        name: weight * min(max(evidence[name], low), high) for name, (weight, low, high) in _TERMS.items()
    }


def unexplained(fit: PoseFit, usual: Usual, mask_weight: float) -> bool:
    """Whether a pose leaves far more of its frame unexplained than is usual."""
    return unusual(fit, usual, mask_weight) > 1


def judge(
    fit: PoseFit, usual: Usual, support: Support, guessed: bool = False, astray: bool = False
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
    odd = unusual(fit, usual, support.mask_weight)
    far, few = odd > 1, not support.settles
    if few and not support.has_mask:
        return Assessment(Status.LOST, "the object is out of sight: no mask, and no points of it", 0.05)
    if far and guessed and not few:
        return Assessment(Status.LOST, "no pose explains the frame; the best of many turns is a guess", 0.05)
    confidence = likelihood(fit, support)
    by_outline = support.plain and support.has_mask and fits_outline(fit, usual)
    if few and far and by_outline:
        reason = (
            f"the outline agrees, pixels do not (loss {fit.appearance:.2f}, usually {usual.appearance:.2f})"
        )
        return Assessment(Status.UNCERTAIN, reason, min(confidence, _BY_OUTLINE))
    if few and far:
        pixels = f"neither pixels (loss {fit.appearance:.2f}, usually {usual.appearance:.2f})"
        mask, points = f"the mask (overlap {fit.overlap:.2f})", f"points ({support.witnesses})"
        if fits_outline(fit, usual):
            reason = f"{pixels} nor {points} agree with any pose, though one fits {mask}"
        else:
            reason = f"{pixels}, nor {mask}, nor {points} agree with any pose"
        return Assessment(Status.LOST, reason, 0.05)
    if not support.has_mask:
        confidence = min(confidence, _UNWITNESSED)
    if few and fit.unseen > _MOSTLY:
        confidence *= 0.5
    if astray and few and confidence < BELIEVED:
        status = Status.UNCERTAIN if by_outline and odd <= 0 else Status.LOST
        return Assessment(
            status, "what was found after the loss may be something else", min(confidence, _BY_OUTLINE)
        )
    if far:
        reason = f"points agree, pixels do not (loss {fit.appearance:.2f})"
        return Assessment(Status.UNCERTAIN, reason, min(confidence, _DOUBTED))
    if confidence >= BELIEVED:
        return Assessment(Status.TRACKED, "", confidence)
    return Assessment(Status.UNCERTAIN, _doubt(fit, support), confidence)


def _doubt(fit: PoseFit, support: Support) -> str:
    """What speaks most against a pose, in words."""
    if not support.settles and fit.unseen > _MOSTLY:
        return "a side that was never seen before: only the outline and the motion so far tell the pose"
    odds = _odds(fit, support)
    best = {name: weight * (high if weight > 0 else low) for name, (weight, low, high) in _TERMS.items()}
    worst = max(odds, key=lambda name: best[name] - odds[name])
    axis = ", ".join(f"{part:.1f}" for part in least_held(fit)[1])
    return _REASONS[worst].format(fit=fit, support=support, axis=axis)
