"""The online solver for a known object: the object is detected instead of initialized, and then tracked as usual."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.estimation.estimate import RELOCALIZED, FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.known_object import KnownObject
from tracking3d.estimation.observation import mask_box
from tracking3d.estimation.online.features.klt import FollowedPoints, grey
from tracking3d.estimation.online.features.sift import Keypoints, detect, match
from tracking3d.estimation.online.known_object.rendered_keyframes import map_of_known_object, sides
from tracking3d.estimation.online.mapper import insert_frame
from tracking3d.estimation.online.mapping.keyframe_insertion import view_frame
from tracking3d.estimation.online.mapping.local_mapping import nearest_views, project_points
from tracking3d.estimation.online.masks.frame_estimates import initial_estimate, learn_colours, make_estimate
from tracking3d.estimation.online.optimization.pose_refinement import refine_poses
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.relocalization import (
    overlaps_mask,
    poses_from_matches,
    should_retry,
)
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.estimation.online.tracking.pose_tracking import candidate_cost, pose_of_points
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix
from tracking3d.rendering import Surface
from tracking3d.runtime.stage_times import in_stage

NOT_SEEN = "the known object has not been seen yet"
_OUTLINED = "outline"
_ENOUGH_ALONE, _MOSTLY_SEEN = 30, 0.5
"""Points that tell a first pose without a mask, and the share of unseen texture below which they do."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class KnownObjectSolver(RefiningSolver[SolverState]):
    """Tracks a known object; estimates are in the object's own coordinates and unit.

    Until the object is detected, frames are estimated as lost, and each is searched. From then on it is the online
    solver, on a map whose shape is fixed.
    """

    config: PipelineConfig  # the pipeline's configuration
    camera: Camera  # the camera of the full frame
    encoder: FeatureEncoder  # the feature encoder
    known_object: KnownObject  # the object

    @cached_property
    def online(self) -> OnlineSolver:
        """The solver that tracks the object once it is detected."""
        return OnlineSolver(self.config, self.camera, self.encoder)

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[SolverState, FrameEstimate]:
        """Take the first frame.

        Raises:
            InputError: If nothing could ever tell where the object is.
        """
        known_object, binary = self.known_object, mask.found
        if binary is None and not known_object.has_colours:
            raise InputError(
                f"{known_object.name} has no colours that it could be found by; say where it is in the first frame: "
                f"{argument('box=', '--box X,Y,W,H')} or {argument('mask=', '--mask FILE')}."
            )
        self._warn_of_lens()
        device = self.online.observer.device
        with in_stage("map"):
            object_map, space = map_of_known_object(known_object, self.config, self.encoder, device)
        pose = Pose.identity(
            object_map.vertices.new_tensor([0.0, 0.0, 4 * self.camera.fy / self.camera.height])
        )
        state = SolverState(
            self.camera, object_map, object_map.surface(), (pose, frame.index), None, grey(frame.image),
            FollowedPoints.none(), None, space,
        )  # fmt: skip
        state, estimate = self._detect(state, frame, binary)
        return state, known_object.answered(estimate)

    def step(self, state: SolverState, frame: Frame, mask: MaskEstimate) -> tuple[SolverState, FrameEstimate]:
        """Take one more frame."""
        if state.trajectory:
            state, estimate = self.online.step(state, frame, mask)
        else:
            state, estimate = self._detect(state, frame, mask.found)
        return state, self.known_object.answered(estimate)

    def refine(self, state: SolverState) -> SolverState:
        """See `OnlineSolver.refine`."""
        return self.online.refine(state)

    def refine_frame(
        self, state: SolverState, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[SolverState, FrameEstimate]:
        """A frame's pose once more, with all that the video has shown."""
        if not state.trajectory:
            estimate = _unseen(initial_estimate(frame, mask.found, state.last_pose[0], state.camera))
            return state, self.known_object.answered(replace(estimate, refined=True))
        causal = self.known_object.to_solver(T_cam_obj)
        state, estimate = self.online.refine_frame(state, frame, mask, causal)
        return state, self.known_object.answered(estimate)

    def start_from(self, state: SolverState, poses: Mapping[int, NDArray[np.float64]]) -> SolverState:
        """See `OnlineSolver.start_from`."""
        return self.online.start_from(state, {at: self.known_object.to_solver(T) for at, T in poses.items()})

    def restart_backwards(
        self, state: SolverState, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
    ) -> SolverState:
        """The state that continues from an earlier frame; see `OnlineSolver.restart_backwards`."""
        turned = self.online.restart_backwards(state, frame, number, self.known_object.to_solver(T_cam_obj))
        return turned if state.trajectory else replace(turned, trajectory=())

    def trust_mask(self, state: SolverState, frame: Frame, mask: NDArray[np.bool_]) -> SolverState:
        """See `OnlineSolver.trust_mask`."""
        return self.online.trust_mask(state, frame, mask)

    def result(self, state: SolverState) -> ObjectModel:
        """The object as it is known."""
        assert state.surface is not None
        features = state.surface.texture.permute(1, 2, 0).cpu().numpy()
        return replace(self.known_object.model, features=features)

    def _detect(
        self, state: SolverState, frame: Frame, mask: NDArray[np.bool_] | None
    ) -> tuple[SolverState, FrameEstimate]:
        """Search for the object in a frame, and initialize with it if it is found."""
        image = grey(frame.image)
        state = self._with_space(state, frame, mask)
        found = self._match_views(state, frame, image, mask)
        if found is None or found.lost or _too_little(found):
            estimate = _unseen(initial_estimate(frame, mask, state.last_pose[0], state.camera), found)
            pose = state.last_pose[0]
            missing = replace(
                state, last_pose=(pose, frame.index), grey=image, lost_frames=state.lost_frames + 1
            )
            return missing, estimate
        pose = found.fit.pose
        begun = replace(
            state, last_pose=(pose, frame.index), previous_pose=None, grey=image, tracked_points=found.points,
            lost_frames=0, doubtful_frames=int(found.doubtful), trajectory=((pose, frame.index),),
            baseline=state.baseline.update(found.fit),
        )  # fmt: skip
        estimate = make_estimate(begun, initial_estimate(frame, mask, pose, state.camera), found)
        # What is not sure must not become what later frames are held against, where there is something better.
        if not found.doubtful or not self.known_object.has_colours:
            view = replace(found.view, pose=pose, points=found.points)
            with in_stage("map"):
                begun = insert_frame(begun, view, image, self.online.options)
            estimate = replace(estimate, keyframe=True)
        return learn_colours(begun, estimate, found), estimate

    def _match_views(
        self, state: SolverState, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> PoseCandidate | None:
        """The object in a frame without any prior; None if no keypoints match."""
        attempts, weights = list[PoseCandidate](), self.online.tracker.weights
        for region in (mask, None) if mask is not None else (None,):
            if self.known_object.has_colours and not _is_sure(attempts):
                attempts += [
                    self._attempt(state, frame, mask, RELOCALIZED, pose, points)
                    for pose, points in by_keypoints(state.object_map, state.camera, image, region)
                ]
        if mask is not None and not _is_sure(attempts) and should_retry(state.lost_frames):
            assert state.surface is not None
            nothing, last = FollowedPoints.none(), state.last_pose[0]
            view = view_frame(self.online.observer, state, frame, mask, last, nothing)
            attempts += [
                self._attempt(state, frame, mask, _OUTLINED, pose, nothing)
                for pose in by_outline(state.surface, state.camera, view, weights)
            ]
        believed = [one for one in attempts if not one.lost] or attempts
        return min(
            believed,
            key=lambda one: candidate_cost(one.fit, weights, one.view.mask_weight, one.evidence.inliers),
            default=None,
        )

    def _attempt(
        self,
        state: SolverState,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        origin: str,
        pose: Pose,
        points: FollowedPoints,
    ) -> PoseCandidate:
        """The pose candidate from a pose that was found in some way."""
        if mask is not None and not overlaps_mask(state.object_map.silhouette(pose, state.camera), mask):
            mask = None
        view = view_frame(self.online.observer, state, frame, mask, pose, points)
        return self.online.tracker.attempt(state, view, origin, guessed=origin == _OUTLINED)

    def _with_space(self, state: SolverState, frame: Frame, mask: NDArray[np.bool_] | None) -> SolverState:
        """The state with the features of an object whose colours only the first frame with a mask determines."""
        if state.feature_space is not None or mask is None or not mask.any():
            return state
        seen = self.online.observer.observe(
            frame, mask, state.last_pose[0], state.object_map.vertices, state.camera, None
        )
        channels = feature_channels(self.encoder, self.config.object.texture_channels)
        return replace(state, feature_space=FeatureSpace.of(seen.features, seen.mask, channels))

    def _warn_of_lens(self) -> None:
        """Log a warning if the focal length is assumed although the object was learnt with another."""
        earlier = self.known_object.camera
        if self.camera.assumed and earlier is not None and earlier.known:
            _log.warning(
                "%s was learnt with a lens of %.1f degrees in pictures of %d x %d pixels, not %d x %d; its lens is "
                "not taken over, and 45 degrees are assumed. Give the lens of this video.",
                self.known_object.name.capitalize(), earlier.fov, earlier.width, earlier.height,
                self.camera.width, self.camera.height,
            )  # fmt: skip


def _is_sure(attempts: list[PoseCandidate]) -> bool:
    return any(not one.doubtful for one in attempts)


def _too_little(found: PoseCandidate) -> bool:
    """Whether only a few points support the pose: no mask confirms it, and they may lie in one spot."""
    enough = found.evidence.inliers >= _ENOUGH_ALONE and found.fit.unseen < _MOSTLY_SEEN
    return found.view.mask is None and found.doubtful and not enough


def _unseen(estimate: FrameEstimate, found: PoseCandidate | None = None) -> FrameEstimate:
    """The estimate before the object has been seen, and what spoke most against the candidate."""
    why = "" if found is None or not found.view.observation.has_mask else f": {found.assessment.reason}"
    return replace(estimate, status=Status.LOST, reason=NOT_SEEN + why, confidence=0.05)


_MAX_KEYPOINTS = 2000  # keypoints of a whole frame, at each size
_LENGTHS = (0.25, 0.75)  # of the frame's height, that the object may have: pictures are scaled for both
_MAX_POSES = 3  # that most keypoints agree with
_MAX_COMBINED = 6  # rendered sides whose matches are combined, once it is known which side is seen
_MAX_REPROJECTION_ERROR = 5.0  # pixels of an object 200 pixels large within which they count
_DIRECTIONS, _ROLLS = 160, 18  # that an outline is tried from
_MAX_ASPECT_DIFFERENCE = 0.4  # logarithm of two boxes' ratios of width and height that are not one outline's
_STAGES = ((120, 2), (24, 8))  # how many go on, and the steps that each then gets
_FINALISTS = 5
_VERTICES = 600  # that tell the box of an outline


def by_keypoints(
    object_map: ObjectMap, camera: Camera, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from keypoint matches, and their inliers, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` the region that is searched; None for the whole frame.
    """
    if mask is None:
        height = image.shape[0]
        everywhere = np.ones(image.shape, bool)
        found = [
            (detect(image, everywhere, share * height, _MAX_KEYPOINTS), share * height / 200)
            for share in _LENGTHS
        ]
    else:
        length = max(mask_box(mask)[2:])
        reach = 2 * max(round(0.05 * length), 1) + 1
        region = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
        found = [(detect(image, region, length, _MAX_KEYPOINTS // 2), length / 200)]
    posed = []
    for keypoints, size in found:
        scale = max(1.0, size)
        for pose, points in poses_from_matches(object_map, camera, keypoints, object_map.keyframes, scale)[
            :_MAX_POSES
        ]:
            posed.append(_combine_matches(object_map, camera, keypoints, pose, points, scale))
    return sorted(posed, key=lambda one: -len(one[1]))[:_MAX_POSES]


def _combine_matches(
    object_map: ObjectMap,
    camera: Camera,
    keypoints: Keypoints,
    pose: Pose,
    points: FollowedPoints,
    scale: float,
) -> tuple[Pose, FollowedPoints]:
    """The pose again, from the matches with all sides near the one seen."""
    together = points
    for other in nearest_views(object_map.keyframes, pose, _MAX_COMBINED):
        pairs = match(keypoints, other.keypoints)
        names = other.keypoint_landmark[pairs[:, 1]]
        pairs, names = pairs[names >= 0], names[names >= 0]
        pixel = keypoints.pixel[pairs[:, 0]]
        gap = np.linalg.norm(project_points(object_map.landmarks[names], pose, camera) - pixel, axis=1)
        first = np.unique(names, return_index=True)[1]
        near = first[gap[first] < _MAX_REPROJECTION_ERROR * scale]
        together = together.concatenate(FollowedPoints(names[near], pixel[near]))
    better = pose_of_points(object_map, camera, together, scale)
    return (pose, points) if better is None or len(better[1]) < len(points) else better


def by_outline(surface: Surface, camera: Camera, view: Keyframe, weights: PoseWeights) -> list[Pose]:
    """The poses, among all rotations, whose outlines and pixels fit a frame's mask best; at least one.

    Args:
        surface: The object.
        camera: The camera of the full frame.
        view: The frame.
        weights: The weights of the kinds of evidence.
    """
    assert view.mask is not None
    poses = _align_candidates(surface, camera, view.mask)
    small = view.observation.half
    fits = refine_poses(surface, small, poses, None, weights, (0,))
    for survivors, steps in _STAGES:
        fits.sort(key=_cost)
        best = [fit.pose for fit in fits[:survivors]]
        fits = refine_poses(surface, small, best, None, weights, (steps,))
    fits.sort(key=_cost)
    return [fit.pose for fit in fits[:_FINALISTS]]


def _cost(fit: PoseFit) -> float:
    total = fit.cost + 1 - fit.overlap
    return total if math.isfinite(total) else math.inf


def _align_candidates(surface: Surface, camera: Camera, mask: NDArray[np.bool_]) -> list[Pose]:
    """Rotations all around, each aligned by its outline's box with the mask's; none whose aspect ratio differs."""
    left, top, width, height = mask_box(mask)
    middle = np.array([left + (width - 1) / 2 - camera.cx, top + (height - 1) / 2 - camera.cy])
    vertices = surface.vertices.double().cpu().numpy()
    vertices = vertices[:: max(len(vertices) // _VERTICES, 1)]
    turns = Rotation.from_euler("z", np.arange(_ROLLS)[:, None] * 360 / _ROLLS, degrees=True).as_matrix()
    R = (turns[None] @ np.stack(sides(_DIRECTIONS))[:, None]).reshape(-1, 3, 3)
    placed = np.einsum("nij,vj->nvi", R[:, :2], vertices)
    low, high = placed.min(1), placed.max(1)
    form = np.maximum(high - low, 1e-6)
    alike = np.abs(np.log(form[:, 0] / form[:, 1] * height / width)) < _MAX_ASPECT_DIFFERENCE
    depth = np.sqrt(camera.fx * form[:, 0] / width * camera.fy * form[:, 1] / height)[:, None]
    shift = depth * middle / [camera.fx, camera.fy] - 0.5 * (low + high)
    t = np.concatenate([shift, depth], 1)
    both = from_matrix(
        torch.from_numpy(R[alike]).to(surface.vertices), torch.from_numpy(t[alike]).to(surface.vertices)
    )
    return [both[n] for n in range(int(alike.sum()))]
