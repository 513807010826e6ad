"""What travels out of the estimator: one estimate a frame, whether its mask is trusted, and the object at the end.

Conventions: OpenCV camera axes (x right, y down, z forward), ``T_cam_obj`` maps object to camera coordinates,
``x_cam = R x_obj + t``; the scale of the object is arbitrary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.points.answers import PointAnswers
from tracking3d.runtime.stage_times import StageTimes


class Status(StrEnum):
    """The estimator's own judgement of one frame."""

    TRACKED = "tracked"
    UNCERTAIN = "uncertain"
    LOST = "lost"


class MaskSource(StrEnum):
    """The source of an estimate's mask."""

    RENDERED = "rendered"
    """The silhouette of the object at the frame's pose."""
    FUSED = "fused"
    """What the image shows between that silhouette and the initial mask."""
    INITIAL = "initial"
    """The initial mask, handed back as it was."""
    NONE = "none"
    """Nothing: there was no initial mask to hand back."""

    @classmethod
    def as_initial(cls, initial: NDArray[np.bool_] | None) -> MaskSource:
        """Of an answer that is the initial mask, if there is one."""
        return cls.NONE if initial is None else cls.INITIAL

    @property
    def is_own(self) -> bool:
        """Whether the answer is more than the input handed back."""
        return self in (MaskSource.RENDERED, MaskSource.FUSED)


UNALIGNED_MAP = "unaligned_map"
"""In `FrameEstimate.diagnostics` if the object was re-initialized after a loss and the transform from the new map to
the earlier one is only a guess."""


FREE_ROTATION = "a surface of revolution: rotation about its axis is not known, the smoothest one is given"
"""Said wherever poses of a run are told that have a `FrameEstimate.free_axis`."""


@dataclass(frozen=True, eq=False)
class FrameEstimate:
    """The estimate for one frame.

    Attributes:
        index: The frame's index in the source.
        time: Seconds since the start of the video, where known.
        T_cam_obj: ``(4, 4)`` float64 rigid transform from object to camera.
        mask: ``(H, W)`` bool, full resolution: the answer. The rendered silhouette, or the initial mask where
            the frame is lost.
        initial_mask: ``(H, W)`` bool as the mask tracker gave it, or None if it gave none.
        status: See `Status`.
        reason: Why the frame has that status, in words.
        confidence: In [0, 1].
        losses: Each loss term at the estimate, unweighted, by name.
        diagnostics: What else tells how far the pose is to be trusted, by name: see docs/run-folder.md.
        iterations: Optimizer iterations spent.
        keyframe: Whether the frame became a keyframe.
        seconds: Wall time spent on the frame, all stages together.
        stages: The same stage by stage, as far as they are over; None if nobody timed them.
        mask_source: Where the mask comes from; None if it is not known.
        probability: ``(H, W)`` float32 of the object, pixel by pixel, where the mask was weighed against the image: the
            mask is where it is above a half. It orders pixels and is not calibrated. None otherwise, and in ``revised``
            estimates without ``runtime.probabilities``.
        failure: Which plug-in failed at this frame, and why, in words; empty if none did.
        hypothesis: The winning hypothesis of the pose, in a word or two; empty if there was no choice.
        refined: Whether this is the answer of the final refinement, which looks at the whole video, and not the
            causal one.
        revised: Better estimates for earlier frames that this frame made possible; they replace those given before.
        camera: The camera of the full frame that the pose refers to. If the focal length is not given, it changes as
            the solver learns more. None if the estimate does not say: the camera known from the first frame on.
        occluder: ``(H, W)`` bool, what the mask tracker says is in front of the object; None if it cannot tell. A
            refined mask takes in what it hides of the object.
        free_axis: ``(3,)`` unit vector in object coordinates: the object looks the same however it is rotated about it,
            so that this part of the pose is not known, see `FREE_ROTATION`; None without one, or before it is found.
        points: Where the points are that `tracking3d.track` was asked to follow; None if it was asked for none.
    """

    index: int
    time: float | None
    T_cam_obj: NDArray[np.float64]
    mask: NDArray[np.bool_]
    initial_mask: NDArray[np.bool_] | None
    status: Status
    reason: str
    confidence: float
    losses: dict[str, float] = field(default_factory=dict)
    iterations: int = 0
    keyframe: bool = False
    seconds: float = 0.0
    failure: str = ""
    hypothesis: str = ""
    refined: bool = False
    stages: StageTimes | None = None
    mask_source: MaskSource | None = None
    revised: tuple[FrameEstimate, ...] = ()
    camera: Camera | None = None
    points: PointAnswers | None = None
    probability: NDArray[np.float32] | None = None
    diagnostics: dict[str, float] = field(default_factory=dict)
    occluder: NDArray[np.bool_] | None = None
    free_axis: NDArray[np.float64] | None = None

    @property
    def visible_mask(self) -> NDArray[np.bool_]:
        """``(H, W)`` bool, what is seen of the object: the mask without what is in front of it."""
        return self.mask if self.occluder is None else self.mask & ~self.occluder


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """The estimated object: one textured mesh in object coordinates.

    Attributes:
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
        face_uvs: ``(F, 3, 2)`` float64, one per face corner, so that the seam of the atlas is exact. u runs to
            the right, v *down* the texture image; u may pass 1 at the seam and wraps.
        texture: ``(T, T, 3)`` uint8 RGB, back-projected from the video.
        texture_weight: ``(T, T)`` float32, how much each texel was seen; 0 = never. Texels off the surface, around
            charts, continue it.
        features: ``(T, T, C)`` float32 feature texture the poses were estimated with.
        seen: ``(V,)`` bool, whether a frame shows a vertex; None if nobody asked, as of the online map's mesh.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float64]
    texture: NDArray[np.uint8]
    texture_weight: NDArray[np.float32]
    features: NDArray[np.float32]
    seen: NDArray[np.bool_] | None = None


def lost_estimate(frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]) -> FrameEstimate:
    """The estimate if the solver has none: lost, with the initial mask and the last known pose."""
    initial = mask.binary if mask.binary is not None and mask.binary.any() else None
    return FrameEstimate(
        index=frame.index,
        time=frame.time,
        T_cam_obj=T_cam_obj,
        mask=initial if initial is not None else np.zeros(frame.size, dtype=np.bool_),
        initial_mask=initial,
        status=Status.LOST,
        reason="",
        confidence=0.0,
        mask_source=MaskSource.as_initial(initial),
    )


def without_masks(estimate: FrameEstimate) -> FrameEstimate:
    """An estimate without what takes much memory."""
    nothing = np.zeros((0, 0), bool)
    return replace(estimate, mask=nothing, initial_mask=None, probability=None, revised=())


def mark_failed(estimate: FrameEstimate, failure: str) -> FrameEstimate:
    """The estimate of a frame in which a plug-in failed: at most uncertain, with half the confidence.

    Args:
        estimate: The estimate.
        failure: Which plug-in failed, and why.
    """
    return replace(
        estimate,
        status=Status.UNCERTAIN if estimate.status is Status.TRACKED else estimate.status,
        reason="; ".join(filter(None, (failure, estimate.reason))),
        confidence=estimate.confidence / 2,
        failure=failure,
    )


SURE = 0.9
"""Confidence from which an answer's mask is handed back to the mask tracker. An answer that is as likely wrong as right
would teach it as many errors as it mends, and what it was taught wrongly comes back as evidence."""

WORTH_CORRECTING = (0.5, 0.9)
"""IoU of answer and initial mask between which the latter is corrected. Above, they differ by little more than the
width of an outline; below, one of them is of something else, and it is not known which."""


_ENOUGH_POINTS = 30
"""Inliers of a frame whose motion carries its mask to the next one (chosen)."""

RELOCALIZED = "relocalized"
"""What `FrameEstimate.hypothesis` says where the object was found by its points alone, anywhere in the frame; where the
mask tracker was elsewhere or had nothing, it is set on what was found, however sure that is."""


ELSEWHERE = 0.2
"""IoU of the object's silhouette, or mask, with the initial mask up to which that is of something else."""


MOTION_RATIO = "motion_ratio"
"""In `FrameEstimate.diagnostics`: the share of the mask by which it differs from the initial mask because of parts that
move as the object does."""

MOVES = 0.02
"""Such a share from which on the answer is handed back, however sure it is: a side that turns into view lies beside the
mask for a few frames only, and a pose that is judged by a mask without it cannot be sure."""


def corrects(estimate: FrameEstimate) -> bool:
    """Whether an estimate is confident enough, and differs enough from the initial mask, to be fed back."""
    moving = estimate.diagnostics.get(MOTION_RATIO, 0.0) >= MOVES
    if estimate.status is not Status.TRACKED and not moving:
        return False
    if estimate.initial_mask is None:
        return estimate.hypothesis == RELOCALIZED
    visible = estimate.visible_mask
    both = int(np.count_nonzero(visible & estimate.initial_mask))
    either = int(np.count_nonzero(visible | estimate.initial_mask))
    if estimate.hypothesis == RELOCALIZED and both <= ELSEWHERE * either:
        return True
    least, most = WORTH_CORRECTING
    if not both or both < least * either:
        return False
    return moving or (estimate.confidence >= SURE and both <= most * either)


CARRIED = "carried"
"""In `FrameEstimate.diagnostics`, 1 if the mask tracker was not asked: the initial mask is that of the frame before,
moved with the object."""


def stands_alone(estimate: FrameEstimate) -> bool:
    """Whether an estimate is so sure that the mask tracker need not be asked in the frame after it.

    A keyframe makes the map, and what it shows of a new side is in no earlier mask.
    """
    sure = estimate.status is Status.TRACKED and estimate.confidence >= SURE
    points = estimate.diagnostics.get("inliers", 0.0) >= _ENOUGH_POINTS
    return sure and points and not estimate.keyframe and not corrects(estimate)


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
