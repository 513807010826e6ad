"""The mask of a frame's estimate: the silhouette and the initial mask, fused by the evidence of the image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.mapping.candidate_landmarks import is_static_scene
from tracking3d.estimation.online.mapping.local_mapping import viewing_angle
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.geometry.camera import Window
from tracking3d.geometry.pose import Pose
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.segmentation import (
    ColourModels,
    as_lab,
    blend_with_initial,
    clean_mask,
    in_question,
    log_odds,
    paste_window,
    pixel_features,
    pose_weight,
    snap_to_edges,
)
from tracking3d.segmentation.initial_mask_agreement import smoothing_of
from tracking3d.segmentation.online_motion_cue import (
    MotionReference,
    grow_region,
    motion_supported_share,
    online_motion_log_odds,
    unlike_surroundings,
)

_DISPUTED = 0.5
"""See `tracking3d.segmentation.in_question`: if both outlines nearly agree, as exact masks do, nothing is missing that
motion could add."""
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
    window, image = upsampled_window(observation)
    lab, own, drawn = as_lab(image), mask_in_window(initial, window), mask_in_window(rendered, window)
    sources = pixel_features(lab, own, drawn, confidence, colours)
    odds, asked = log_odds(sources), in_question(sources)
    told = moving() if moving is not None and asked >= _DISPUTED else None
    if told is not None:
        odds = grow_region(odds, own, drawn, told, unlike_surroundings(lab, own | drawn))
    odds, asked = blend_with_initial(odds, own, 1 - initial_weight), smoothing_of(initial_weight) * asked
    support = _extract(image, odds, asked, initial, window)
    share = 0.0 if told is None else motion_supported_share(support > 0, own, told)
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
    window, image = upsampled_window(observation)
    covered = occluder_in_window(observation)
    return ColourModels.of(as_lab(image), mask_in_window(mask, window), colours, covered)


def upsampled_window(observation: Observation) -> tuple[Window, NDArray[np.uint8]]:
    """The window upsampled to side ``S``, and its image ``(S, S, 3)`` RGB."""
    window = replace(observation.window, size=_UPSAMPLING * observation.window.size)
    image = (255 * observation.image.permute(1, 2, 0)).round().clamp(0, 255).cpu().numpy()
    return window, np.ascontiguousarray(image.astype(np.uint8))


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
    state: SolverState, found: PoseCandidate, image: NDArray[np.uint8]
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
    window, _ = upsampled_window(found.view.observation)
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
    for position, view in enumerate(object_map.keyframes):
        if viewing_angle(view.pose, pose) < _SAME_DIRECTION and any(
            viewing_angle(view.pose, later.pose) > _MIN_ROTATION
            for later in object_map.keyframes[position + 1 :]
        ):
            return True
    return False


def remember_motion(
    state: SolverState, estimate: FrameEstimate, found: PoseCandidate, image: NDArray[np.uint8]
) -> SolverState:
    """The state that remembers a reliable frame; after a loss the memory starts empty."""
    if found.lost:
        return replace(state, motion_references=())
    if found.evidence.inliers < _MIN_INLIERS:
        return state
    seen = MotionReference.of(image, estimate.mask, estimate.T_cam_obj)
    return replace(state, motion_references=(*state.motion_references, seen)[-_MAX_REFERENCES:])
