"""The solver's estimate for a frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import MOTION_RATIO, FrameEstimate, MaskSource, Status
from tracking3d.estimation.online.masks.mask_fusion import FusedMask, fuse_mask, update_colours
from tracking3d.estimation.online.optimization.pose_refinement import least_constrained_axis
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import MaskAgreement, SolverState
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.scene.view import ObjectView
from tracking3d.segmentation.initial_mask_agreement import InitialMaskAgreement
from tracking3d.segmentation.whole_video import draw_around_masks


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


def learn_colours(state: SolverState, estimate: FrameEstimate, found: PoseCandidate) -> SolverState:
    """The state with the colour models updated by a reliable frame."""
    if found.doubtful or found.view.mask is None:
        return state
    return replace(state, colours=update_colours(state.colours, found.view.observation, estimate.mask))


def make_estimate(
    state: SolverState,
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
        diagnostics={
            "inliers": float(found.evidence.inliers),
            "outlier_ratio": found.evidence.outlier_ratio,
            "min_curvature": least_constrained_axis(fit)[0],
            "unseen_ratio": fit.unseen,
            "mask_iou": fit.overlap,
            "mask_confidence": view.mask_weight,
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


def measure_mask_agreement(state: SolverState) -> SolverState:
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
    """The agreement of the keyframes' masks; see `tracking3d.segmentation.initial_mask_agreement`."""
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
