"""The solver's estimate for a frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import MOTION_RATIO, FrameEstimate, MaskSource, Status
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.mapping.keyframe_insertion import is_static_scene
from tracking3d.estimation.online.mapping.local_mapping import viewing_angle
from tracking3d.estimation.online.optimization.pose_refinement import least_constrained_axis
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped, MaskAgreement
from tracking3d.estimation.segmentation import (
    ColourModels,
    as_lab,
    blend_with_initial,
    clean_mask,
    image_weight,
    log_odds,
    paste_window,
    pixel_features,
    pose_weight,
    snap_to_edges,
)
from tracking3d.estimation.segmentation.initial_mask_agreement import InitialMaskAgreement, smoothing_of
from tracking3d.estimation.segmentation.online_motion_cue import (
    MotionReference,
    grow_region,
    motion_supported_share,
    online_motion_log_odds,
    unlike_surroundings,
)
from tracking3d.estimation.segmentation.whole_video import draw_around_masks
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose
from tracking3d.scene.view import ObjectView, crop_window, inside_frame


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


def learn_colours(state: Mapped, estimate: FrameEstimate, found: PoseCandidate) -> Mapped:
    """The state with the colour models updated by a reliable frame."""
    if found.doubtful or found.view.mask is None:
        return state
    return replace(state, colours=update_colours(state.colours, found.view.observation, estimate.mask))


def make_estimate(
    state: Mapped,
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
            **({} if math.isnan(found.evidence.lead) else {"lead": found.evidence.lead}),
            MOTION_RATIO: weighed.moving,
        },
    )


_MOST_KEYFRAMES = 16
_GROWTH = 1.5
"""The agreement is measured again when there are so many times more keyframes: each time costs .2 s."""
_SLACK = 1.5
"""Causal poses are less exact than refined ones, and masks differ more from their hull."""
_USUAL, _ANOTHER = 0.05, 0.15
"""Share of a mask that may lie beyond the silhouette above the usual one; from the second on it shows another thing."""


def measure_mask_agreement(state: Mapped) -> Mapped:
    """The state with the agreement of its keyframes' masks, if there are enough more of these than the last time."""
    measured, count = state.mask_agreement.keyframes, len(state.object_map.keyframes)
    if measured <= count < max(_GROWTH * measured, 1):
        return state
    return replace(state, mask_agreement=mask_agreement(state.object_map, state.camera))


def initial_mask_weight(
    agreement: MaskAgreement, initial: NDArray[np.bool_], silhouette: NDArray[np.bool_]
) -> float:
    """The weight of a frame's initial mask, in [0, 1]: less if more of it than usual lies beyond the silhouette.

    Args:
        agreement: That of the keyframes.
        initial: ``(H, W)`` the frame's initial mask.
        silhouette: ``(H, W)`` at the frame's pose. What hides a part of the object takes it from the mask alone.
    """
    if not agreement.weight:
        return 0.0
    more = share_beyond(initial, silhouette) - agreement.beyond
    return agreement.weight * float(np.clip((_ANOTHER - more) / (_ANOTHER - _USUAL), 0, 1))


def share_beyond(mask: NDArray[np.bool_], silhouette: NDArray[np.bool_]) -> float:
    """The share of a mask that lies beyond a silhouette of the same size; 0 of an empty mask."""
    return np.count_nonzero(mask & ~silhouette) / max(int(np.count_nonzero(mask)), 1)


def mask_agreement(object_map: ObjectMap, camera: Camera) -> MaskAgreement:
    """The agreement of the keyframes' masks; see `tracking3d.estimation.segmentation.initial_mask_agreement`."""
    vertices = object_map.vertices.cpu().numpy().astype(np.float64)
    faces = object_map.shape.faces.cpu().numpy().astype(np.int64)
    views = [view for view in object_map.keyframes if view.mask is not None and view.mask.any()]
    places = np.linspace(0, len(views) - 1, min(_MOST_KEYFRAMES, len(views))).round().astype(int)
    found, beyond = InitialMaskAgreement(vertices, _SLACK), list[float]()
    for view in (views[place] for place in places):
        assert view.mask is not None
        image = np.zeros((*view.mask.shape, 3), np.uint8)
        T_cam_obj = view.pose.matrix().numpy().astype(np.float64)
        frame = ObjectView.of_frame(view.index, image, view.mask, camera, T_cam_obj, initial=view.mask)
        drawn = draw_around_masks(frame, vertices, faces)
        if drawn is not None:
            found.see(drawn)
            beyond.append(share_beyond(drawn.initial, drawn.silhouette))
    found.settle()
    usual = float(np.median(beyond)) if beyond else 0.0
    return MaskAgreement(found.weight, usual, len(object_map.keyframes))


_DISPUTED = 0.5
"""See `tracking3d.estimation.segmentation.image_weight`: if both outlines nearly agree, as exact masks do, nothing is
missing that motion could add."""
_UPSAMPLING = 2
"""Pixels of the fusion window for each pixel of the observation's window, per side."""


@dataclass(frozen=True, eq=False)
class FusedMask:
    """The mask of a frame's estimate."""

    mask: NDArray[np.bool_]  # (H, W)
    source: MaskSource  # its source
    # (H, W) of the object; the mask is where it exceeds a half. None if the masks were not fused.
    probability: NDArray[np.float32] | None = None
    moving: float = 0.0  # share of the mask that differs from the initial one because of the motion cue


def fuse_mask(
    rendered: NDArray[np.bool_],
    initial: NDArray[np.bool_] | None,
    observation: Observation,
    confidence: float,
    colours: ColourModels | None,
    moving: Callable[[], NDArray[np.float32] | None] | None = None,
    initial_weight: float = 0.0,
) -> FusedMask:
    """Fuse the silhouette and the initial mask by the evidence of the image.

    Args:
        rendered: ``(H, W)`` the silhouette at the frame's pose.
        initial: ``(H, W)`` the mask tracker's, or None.
        observation: The frame.
        confidence: The pose's confidence.
        colours: The colours in earlier frames, or None.
        moving: Computes the motion cue in the window of `upsampled_window`, ``(S, S)``, or None if it is unknown;
            called only if it is needed.
        initial_weight: How far the initial mask is kept because it agrees with those of other frames, in [0, 1].
    """
    if initial is None:
        return FusedMask(rendered, MaskSource.RENDERED)
    if initial_weight == 1:
        return FusedMask(initial, MaskSource.INITIAL)
    window, image, lab = upsampled_window(observation)
    own, drawn = mask_in_window(initial, window), mask_in_window(rendered, window)
    sources = pixel_features(lab, own, drawn, confidence, colours)
    odds, asked = log_odds(sources), image_weight(sources)
    told = moving() if moving is not None and asked >= _DISPUTED else None
    if told is not None:
        odds = grow_region(odds, own, drawn, told, unlike_surroundings(lab, own | drawn))
    odds, asked = blend_with_initial(odds, own, 1 - initial_weight), smoothing_of(initial_weight) * asked
    share = 0.0
    if told is not None:
        support = _extract(image, odds, asked, initial, window)
        share = motion_supported_share(support > 0, own, told)
    if not share:  # nothing but the silhouette speaks against the initial mask
        if not pose_weight(confidence):
            return FusedMask(initial, MaskSource.INITIAL)
        odds = blend_with_initial(odds, own, pose_weight(confidence))
        support = _extract(image, odds, asked, initial, window)
    # The window is the initial mask's: beyond it the silhouette of a reliable pose defines the object alone.
    beyond = rendered if share or pose_weight(confidence) == 1 else initial
    full = paste_window(support, window, np.where(beyond, 1.0, -1.0).astype(np.float32))
    mask = full > 0
    if not mask.any():  # an empty mask means that the evidence supports neither
        return FusedMask(initial, MaskSource.INITIAL)
    return FusedMask(mask, MaskSource.FUSED, 0.5 + 0.5 * full, share)


def _extract(
    image: NDArray[np.uint8],
    odds: NDArray[np.float32],
    asked: float,
    initial: NDArray[np.bool_],
    window: Window,
) -> NDArray[np.float32]:
    """``(S, S)`` support in the window, negative beyond the frame."""
    support = clean_mask(snap_to_edges(image, odds, asked))
    support[~inside_frame(initial.shape, window)] = -1
    return support


def update_colours(
    colours: ColourModels | None, observation: Observation, mask: NDArray[np.bool_]
) -> ColourModels | None:
    """The colour models after a frame with ``mask`` ``(H, W)``; what is in front of the object is left out."""
    window, _, lab = upsampled_window(observation)
    return ColourModels.of(lab, mask_in_window(mask, window), colours, occluder_in_window(observation))


@lru_cache(maxsize=1)  # of the frame at hand: it is asked for three times
def upsampled_window(observation: Observation) -> tuple[Window, NDArray[np.uint8], NDArray[np.uint8]]:
    """The window upsampled to side ``S``, and its image ``(S, S, 3)``, RGB and Lab."""
    window = replace(observation.window, size=_UPSAMPLING * observation.window.size)
    image = (255 * observation.image.permute(1, 2, 0)).round().clamp(0, 255).cpu().numpy()
    image = np.ascontiguousarray(image.astype(np.uint8))
    return window, image, as_lab(image)


def occluder_in_window(observation: Observation) -> NDArray[np.bool_] | None:
    """``(S, S)`` what is in front of the object, in the window of `upsampled_window`; None if nothing is known."""
    if observation.occluder is None:
        return None
    covered = (observation.occluder > 0.5).cpu().numpy()
    return covered.repeat(_UPSAMPLING, 0).repeat(_UPSAMPLING, 1)


def mask_in_window(mask: NDArray[np.bool_], window: Window) -> NDArray[np.bool_]:
    """``(S, S)`` a mask ``(H, W)`` cropped to a window."""
    # Pixels beyond the frame are not the object, although `crop_window` repeats the border.
    seen = crop_window(mask, window) > 0.5
    return np.asarray(seen & inside_frame(mask.shape, window))


_MAX_REFERENCES = 10  # most earlier frames
_SAME_DIRECTION, _MIN_ROTATION = 12.0, 30.0  # degrees between viewing directions
_MIN_INLIERS = 20  # fewest inliers of a pose whose motion is used


def motion_cue_in_window(
    state: Mapped, found: PoseCandidate, image: NDArray[np.uint8]
) -> NDArray[np.float32] | None:
    """``(S, S)`` the motion cue in the window of `upsampled_window`; None if it cannot be determined.

    Args:
        state: The state before the frame.
        found: The frame's pose candidate.
        image: ``(H, W)`` grey.
    """
    mask = found.view.mask
    if mask is None or found.lost or found.evidence.inliers < _MIN_INLIERS or not state.motion_references:
        return None
    object_map, pose = state.object_map, found.fit.pose
    if is_static_scene(object_map.candidates_around):
        return None
    taken = mask | object_map.silhouette(pose, state.camera)
    if taken[[0, -1]].any() or taken[:, [0, -1]].any():  # an object cut off by the frame's border is leaving
        return None
    here = MotionReference.of(image, taken, pose.matrix().numpy())
    vertices = object_map.vertices.double().cpu().numpy()
    window, _, _ = upsampled_window(found.view.observation)
    moving = online_motion_log_odds(
        here, state.motion_references, window, state.camera, vertices, object_map.shape.faces.cpu().numpy()
    )
    if moving is not None and is_seen_again(object_map, pose):
        moving = np.where(mask_in_window(taken, window), moving, np.minimum(moving, 0))
    return moving


def is_seen_again(object_map: ObjectMap, pose: Pose) -> bool:
    """Whether a keyframe shows this side and the object has rotated away since, so that no part of it is new.

    What moves with the object next to its mask is then a hand.
    """
    poses = [view.pose for view in object_map.keyframes]
    return any(
        viewing_angle(one, pose) < _SAME_DIRECTION
        and any(viewing_angle(one, later) > _MIN_ROTATION for later in poses[position + 1 :])
        for position, one in enumerate(poses)
    )


def remember_motion(
    state: Mapped, estimate: FrameEstimate, found: PoseCandidate, image: NDArray[np.uint8]
) -> Mapped:
    """The state that remembers a reliable frame; after a loss the memory starts empty."""
    if found.lost:
        return replace(state, motion_references=())
    if found.evidence.inliers < _MIN_INLIERS:
        return state
    seen = MotionReference.of(image, estimate.mask, estimate.T_cam_obj)
    return replace(state, motion_references=(*state.motion_references, seen)[-_MAX_REFERENCES:])
