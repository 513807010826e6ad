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
from torch import Tensor

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.estimation.estimate import RELOCALIZED, FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.observation import Observation, crop, mask_box, observe
from tracking3d.estimation.online.features.klt import FollowedPoints, grey
from tracking3d.estimation.online.features.sift import SIFT, Detector, Keypoints, detect_turned, match
from tracking3d.estimation.online.mapper import insert_frame
from tracking3d.estimation.online.mapping.keyframe_insertion import view_frame
from tracking3d.estimation.online.mapping.local_mapping import nearest_views, project_points, with_landmarks
from tracking3d.estimation.online.masks import initial_estimate, learn_colours, make_estimate
from tracking3d.estimation.online.optimization.pose_refinement import refine_poses
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.pose_tracking import candidate_cost, pose_of_points
from tracking3d.estimation.online.relocalization import overlaps_mask, poses_from_matches, should_retry
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped, SolverState
from tracking3d.estimation.shape import RADIUS, Shape
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.pose import Pose, from_matrix, pose_arrays, pose_from_arrays
from tracking3d.rendering import BackProjection, Surface, TexelMap, back_project, project, rasterize
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.surface import sample_texture
from tracking3d.runtime.stage_times import in_stage

NOT_SEEN = "the known object has not been seen yet"
_OUTLINED = "outline"
_ENOUGH_ALONE, _MOSTLY_SEEN = 30, 0.5
"""Points that tell a first pose without a mask, and the share of unseen texture below which they do."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object that an earlier run, a scan or a drawing knows.

    Solvers have it with its middle at the origin and a radius of `tracking3d.estimation.shape.RADIUS`, since
    their tolerances are made for that; what they answer is turned back into the object's own coordinates and unit.
    """

    name: str  # what sentences call it
    model: ObjectModel  # in its own coordinates; texture_weight is 0 if its colours are not known
    camera: Camera | None = None  # the camera that it was learnt with; None if there was none

    @property
    def has_colours(self) -> bool:
        """Whether the colours of any of it are known."""
        return bool((self.model.texture_weight > 0).any())

    @cached_property
    def centre(self) -> NDArray[np.float64]:
        """``(3,)`` the middle of its bounding box."""
        vertices = self.model.vertices
        return np.asarray(0.5 * (vertices.min(0) + vertices.max(0)))

    @cached_property
    def scale(self) -> float:
        """The solver's units in one of the object's own."""
        return RADIUS / max(float(np.linalg.norm(self.model.vertices - self.centre, axis=1).max()), 1e-12)

    @cached_property
    def vertices(self) -> NDArray[np.float64]:
        """``(V, 3)`` as the solver has them."""
        return np.asarray(self.scale * (self.model.vertices - self.centre))

    def to_solver(self, T_cam_obj: NDArray[np.float64]) -> NDArray[np.float64]:
        """``(4, 4)`` the solver's pose for one of the object in its own coordinates."""
        T = T_cam_obj.copy()
        T[:3, 3] = self.scale * (T_cam_obj[:3, :3] @ self.centre + T_cam_obj[:3, 3])
        return T

    def from_solver(self, T_cam_obj: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `to_solver`."""
        T = T_cam_obj.copy()
        T[:3, 3] = T_cam_obj[:3, 3] / self.scale - T_cam_obj[:3, :3] @ self.centre
        return T

    def answered(self, estimate: FrameEstimate) -> FrameEstimate:
        """A solver's estimate with the pose in the object's own coordinates."""
        earlier = tuple(self.answered(one) for one in estimate.revised)
        return replace(estimate, T_cam_obj=self.from_solver(estimate.T_cam_obj), revised=earlier)


@dataclass(frozen=True)
class KnownObjectSolver(RefiningSolver[Mapped]):
    """Tracks a known object; estimates are in the object's own coordinates and unit.

    Until the object is detected, frames are estimated as lost, and each is searched. From then on it is the online
    solver, on a map whose shape is fixed.
    """

    config: PipelineConfig  # the pipeline's configuration
    camera: Camera  # the camera of the full frame
    encoder: FeatureEncoder  # the feature encoder
    known_object: KnownObject  # the object
    detector: Detector = SIFT  # what finds keypoints

    @cached_property
    def online(self) -> OnlineSolver:
        """The solver that tracks the object once it is detected."""
        return OnlineSolver(self.config, self.camera, self.encoder, self.detector)

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[Mapped, FrameEstimate]:
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
            object_map, space = map_of_known_object(
                known_object, self.config, self.encoder, device, self.detector
            )
        pose = Pose.identity(
            object_map.vertices.new_tensor([0.0, 0.0, 4 * self.camera.fy / self.camera.height])
        )
        state = Mapped(
            self.camera, object_map, (pose, frame.index), grey(frame.image), FollowedPoints.none(), space,
            surface=object_map.surface(),
        )  # fmt: skip
        state, estimate = self._detect(state, frame, binary)
        return state, known_object.answered(estimate)

    def step(self, state: Mapped, frame: Frame, mask: MaskEstimate) -> tuple[Mapped, FrameEstimate]:
        """Take one more frame."""
        if state.trajectory:
            followed, estimate = self.online.step(state, frame, mask)
            state = _with_map(followed)
        else:
            state, estimate = self._detect(state, frame, mask.found)
        return state, self.known_object.answered(estimate)

    def refine(self, state: Mapped) -> Mapped:
        """See `OnlineSolver.refine`."""
        return _with_map(self.online.refine(state))

    def refine_frame(
        self, state: Mapped, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[Mapped, FrameEstimate]:
        """A frame's pose once more, with all that the video has shown."""
        if not state.trajectory:
            estimate = _unseen(initial_estimate(frame, mask.found, state.last_pose[0], state.camera))
            return state, self.known_object.answered(replace(estimate, refined=True))
        causal = self.known_object.to_solver(T_cam_obj)
        followed, estimate = self.online.refine_frame(state, frame, mask, causal)
        return _with_map(followed), self.known_object.answered(estimate)

    def start_from(self, state: Mapped, poses: Mapping[int, NDArray[np.float64]]) -> Mapped:
        """See `OnlineSolver.start_from`."""
        return replace(state, extended={at: self.known_object.to_solver(T) for at, T in poses.items()})

    def restart_backwards(
        self, state: Mapped, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
    ) -> Mapped:
        """The state that continues from an earlier frame; see `OnlineSolver.restart_backwards`."""
        T_cam_obj = self.known_object.to_solver(T_cam_obj)
        turned = _with_map(self.online.restart_backwards(state, frame, number, T_cam_obj))
        return turned if state.trajectory else replace(turned, trajectory=())

    def trust_mask(self, state: Mapped, frame: Frame, mask: NDArray[np.bool_]) -> Mapped:
        """See `OnlineSolver.trust_mask`."""
        return _with_map(self.online.trust_mask(state, frame, mask))

    def result(self, state: Mapped) -> ObjectModel:
        """The object as it is known."""
        features = state.surface.texture.permute(1, 2, 0).cpu().numpy()
        return replace(self.known_object.model, features=features)

    def _detect(
        self, state: Mapped, frame: Frame, mask: NDArray[np.bool_] | None
    ) -> tuple[Mapped, FrameEstimate]:
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
                begun = insert_frame(begun, view, image, self.online.options, self.detector)
            estimate = replace(estimate, keyframe=True)
        return learn_colours(begun, estimate, found), estimate

    def _match_views(
        self, state: Mapped, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> PoseCandidate | None:
        """The object in a frame without any prior; None if no keypoints match."""
        attempts, weights = list[PoseCandidate](), self.online.tracker.weights
        for region in (mask, None) if mask is not None else (None,):
            if self.known_object.has_colours and not _is_sure(attempts):
                attempts += [
                    self._attempt(state, frame, mask, RELOCALIZED, pose, points)
                    for pose, points in by_keypoints(
                        state.object_map, state.camera, image, region, self.detector
                    )
                ]
        if mask is not None and not _is_sure(attempts) and should_retry(state.lost_frames):
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
        state: Mapped,
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

    def _with_space(self, state: Mapped, frame: Frame, mask: NDArray[np.bool_] | None) -> Mapped:
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


def _with_map(state: SolverState) -> Mapped:
    """The online solver's state, which has a map: that of a known object does from the first frame on."""
    assert isinstance(state, Mapped)
    return state


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
    object_map: ObjectMap,
    camera: Camera,
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    detector: Detector = SIFT,
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from keypoint matches, and their inliers, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` the region that is searched; None for the whole frame.
        detector: What finds keypoints.
    """
    if mask is None:
        height = image.shape[0]
        everywhere = np.ones(image.shape, bool)
        found = [
            (keypoints, share * height / 200)
            for share in _LENGTHS
            for keypoints in detect_turned(
                image, everywhere, detector, length=share * height, most=_MAX_KEYPOINTS
            )
        ]
    else:
        length = max(mask_box(mask)[2:])
        reach = 2 * max(round(0.05 * length), 1) + 1
        region = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
        turns = detect_turned(image, region, detector, length=length, most=_MAX_KEYPOINTS // 2)
        found = [(keypoints, length / 200) for keypoints in turns]
    posed = []
    for keypoints, size in found:
        scale = max(1.0, size)
        for pose, points in poses_from_matches(object_map, camera, (keypoints,), object_map.keyframes, scale)[
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


# The map of an object that is known before the video begins, rendered from all sides.
#
# Every rendered side becomes a keyframe whose keypoints are points of the surface; from then on the object is tracked
# like any other, except that its shape is fixed.

SIDES = 42
"""Directions that the object is drawn from: neighbours are about 33 degrees apart, so no view of it is farther than
about 20 from one of them, which keypoints bridge."""
_PICTURE = 320  # pixels
_SUPERSAMPLING = 2  # times, for drawing, so that nothing is jagged
_FIELD_OF_VIEW = 30.0
_FILLED = 0.85  # of the picture, by the sphere around the object
_MAX_TEXELS = 1024  # along a side of the texture that is drawn
_MARGIN = 3  # pixels that keypoints stay away from what was never seen
_TEXTURE_WEIGHT = 3.0  # weight of the known texture, in views of the new video that show it head-on
_FINEST_TEXELS, _TEXELS_OF_A_FACE = 512, 4.0


@dataclass(frozen=True, eq=False)
class RenderedSide:
    """One side of an object, drawn."""

    image: NDArray[np.uint8]  # (S, S, 3) uint8
    mask: NDArray[np.bool_]  # (S, S) its silhouette; known: where its colours are known
    known: NDArray[np.bool_]
    # (S, S, 3) surface points in object coordinates, at the pixels' centres; NaN in the background
    points: NDArray[np.float32]


def map_of_known_object(
    known: KnownObject,
    config: PipelineConfig,
    encoder: FeatureEncoder,
    device: torch.device,
    detector: Detector = SIFT,
) -> tuple[ObjectMap, FeatureSpace | None]:
    """The map and the feature space; None for the latter if no known colours determine it.

    Args:
        known: The object.
        config: The pipeline.
        encoder: The feature encoder.
        device: Where tensors live.
        detector: What finds keypoints.
    """
    model, renderer = known.model, config.runtime.renderer
    shape = Shape.of(Mesh(known.vertices, model.faces, model.face_uvs), False, device)
    texels = TexelMap.of(shape.face_uvs, _texels(config.object.texture_size, len(model.faces)))
    learnt = ObjectMap(
        shape,
        texels,
        shape.rest,
        np.zeros((0, 3)),
        (),
        np.zeros(0, bool),
        renderer=renderer,
    )
    camera = Camera.from_fov(_PICTURE, _PICTURE, _FIELD_OF_VIEW)
    distance = RADIUS / math.sin(_FILLED * math.radians(_FIELD_OF_VIEW) / 2)
    colours = _colours(known).to(device)
    seen: list[tuple[Keyframe, RenderedSide]] = []
    for number, R in enumerate(sides(SIDES)):
        pose = pose_from_arrays(R, np.array([0.0, 0.0, distance]), shape.rest)
        drawing = render_side(shape, colours, pose, camera, renderer)
        if not drawing.mask.any():
            continue  # a flat thing, from its edge
        # Drawn sides come before the first frame.
        frame = Frame(number - SIDES, drawing.image)
        window = Window.around(mask_box(drawing.mask), config.crop.margin, config.crop.size)
        observation = observe(frame, drawing.mask, window, camera, encoder, device)
        view = Keyframe(observation, drawing.mask, pose, FollowedPoints.none())
        learnt, view = _with_points(learnt, camera, view, drawing, detector)
        learnt = replace(learnt, keyframes=(*learnt.keyframes, view))
        seen.append((view, drawing))
    channels = feature_channels(encoder, config.object.texture_channels)
    space = _space(seen, channels) if known.has_colours else None
    texture = _texture(learnt, seen, space, channels)
    nothing = BackProjection(torch.zeros_like(texture.total), torch.zeros_like(texture.weight))
    keyframes = tuple(
        replace(
            view,
            observation=_without_pixels(view.observation, channels),
            mask=None,
            texture=nothing if number else texture,
        )
        for number, view in enumerate(learnt.keyframes)
    )
    return replace(learnt, keyframes=keyframes, fixed_keyframes=len(keyframes)), space


def sides(count: int) -> list[NDArray[np.float64]]:
    """Rotations ``(3, 3)``, object to camera, that show an object from so many directions, evenly over the sphere."""
    turn = math.pi * (3 - math.sqrt(5))  # the golden angle: a Fibonacci lattice
    rotations = []
    for number in range(count):
        up = 1 - 2 * (number + 0.5) / count
        ring = math.sqrt(1 - up**2)
        forward = np.array([ring * math.cos(turn * number), up, ring * math.sin(turn * number)])
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotations.append(np.stack([right, np.cross(forward, right), forward]))
    return rotations


@torch.no_grad()
def render_side(
    shape: Shape, colours: Tensor, pose: Pose, camera: Camera, renderer: str = "auto"
) -> RenderedSide:
    """Draw an object before a background of its mean colour, which puts no edge of its own along the outline.

    Args:
        shape: The object.
        colours: ``(4, T, T)`` RGB in [0, 1], and 1 where it is known, else 0.
        pose: The pose of the object.
        camera: Square.
        renderer: See `tracking3d.rendering.backend`.
    """
    size = _SUPERSAMPLING * camera.width
    fine = (
        _SUPERSAMPLING * camera.fx,
        (camera.cx + 0.5) * _SUPERSAMPLING - 0.5,
        (camera.cy + 0.5) * _SUPERSAMPLING - 0.5,
    )
    K = colours.new_tensor([[fine[0], 0, fine[1]], [0, fine[0], fine[2]], [0, 0, 1]])
    screen, depth = project(shape.rest, pose.R[None], pose.translation[None], K[None])
    face_index = rasterize(screen, depth, shape.faces, (size, size), renderer).face_index
    corners = torch.cat([shape.face_uvs, shape.rest[shape.faces]], 2)
    at = interpolate(screen, depth, shape.faces, corners, face_index, renderer)
    layers = sample_texture(colours, at[:, :2])
    object_map = layers[:, 3:] > 0.5
    mean = (layers[:, :3] * object_map).sum(0) / object_map.sum().clamp_min(1)
    covered = (face_index[0] >= 0).cpu().numpy()
    picture = np.empty((size, size, 3), np.float32)
    picture[:] = mean.cpu().numpy()
    picture[covered] = (
        torch.where(object_map, layers[:, :3] / layers[:, 3:].clamp_min(1e-6), mean).cpu().numpy()
    )
    seen = np.zeros((size, size), np.float32)
    seen[covered] = object_map[:, 0].float().cpu().numpy()
    points = np.full((size, size, 3), np.nan, np.float32)
    points[covered] = at[:, 2:].cpu().numpy()

    def reduced(values: NDArray[np.float32]) -> NDArray[np.float32]:
        side = camera.width, camera.height
        return np.asarray(cv2.resize(values, side, interpolation=cv2.INTER_AREA), dtype=np.float32)

    # The centre of a pixel is where four finer ones meet; all of them must lie on the object.
    corners_of = [
        points[row::_SUPERSAMPLING, column::_SUPERSAMPLING]
        for row in range(_SUPERSAMPLING)
        for column in range(_SUPERSAMPLING)
    ]
    return RenderedSide(
        (255 * reduced(picture)).round().clip(0, 255).astype(np.uint8),
        reduced(covered.astype(np.float32)) > 0.5,
        reduced(seen) > 0.99,
        np.mean(corners_of, axis=0, dtype=np.float32),
    )


def _with_points(
    learnt: ObjectMap, camera: Camera, view: Keyframe, drawing: RenderedSide, detector: Detector
) -> tuple[ObjectMap, Keyframe]:
    """With landmarks at a drawn side's keypoints, exactly on the surface."""
    kernel = np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8)
    inside = cv2.erode((drawing.known & drawing.mask).astype(np.uint8), kernel) > 0
    (keypoints,) = detect_turned(grey(drawing.image), inside, detector, pose_arrays(view.pose)[0])
    before = len(learnt.landmarks)
    learnt, view = with_landmarks(learnt, camera, view, keypoints, np.zeros((0, 2), np.float32))
    fresh = view.points.landmark >= before
    landmarks, pixel = learnt.landmarks.copy(), view.points.pixel[fresh]
    exact = _sample_surface(drawing.points, pixel)
    sound = np.isfinite(exact).all(1)
    landmarks[view.points.landmark[fresh][sound]] = exact[sound]
    return replace(learnt, landmarks=landmarks), view


def _sample_surface(points: NDArray[np.float32], pixel: NDArray[np.float32]) -> NDArray[np.float64]:
    """``(N, 3)`` of ``points`` ``(S, S, 3)`` between four pixels; nan if one of those is."""
    low = np.floor(pixel).astype(int).clip(0, len(points) - 2)
    (x, y), (right, down) = low.T, (pixel - low).T[..., None]
    upper = (1 - right) * points[y, x] + right * points[y, x + 1]
    lower = (1 - right) * points[y + 1, x] + right * points[y + 1, x + 1]
    return np.asarray((1 - down) * upper + down * lower)


def _colours(object_map: KnownObject) -> Tensor:
    """``(4, T, T)`` see `render_side`; no finer than pictures show them, with nothing mixed in that was never seen."""
    texture = object_map.model.texture.astype(np.float32) / 255
    seen = (object_map.model.texture_weight > 0).astype(np.float32)
    layers = np.concatenate([texture * seen[..., None], seen[..., None]], 2)
    height, width = seen.shape
    shrink = _MAX_TEXELS / max(height, width)
    if shrink < 1:
        size = max(round(shrink * width), 1), max(round(shrink * height), 1)
        layers = cv2.resize(layers, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.ascontiguousarray(layers.transpose(2, 0, 1)))


def _texels(size: int, faces: int) -> int:
    """Texels along a side of the feature texture: more where an atlas of single faces would else blur them."""
    return max(size, min(round(_TEXELS_OF_A_FACE * math.sqrt(faces / 2)), _FINEST_TEXELS))


def _space(seen: list[tuple[Keyframe, RenderedSide]], channels: int) -> FeatureSpace:
    """The main components of the object's features over all its sides."""
    features = torch.cat([view.observation.features for view, _ in seen], 2)
    mask = torch.cat([_trusted_texture(view, drawing) for view, drawing in seen], 1)
    return FeatureSpace.of(features, mask, channels)


def _trusted_texture(view: Keyframe, drawing: RenderedSide) -> Tensor:
    """``(S, S)`` the part of a drawn side's window in which the colours are known."""
    known = torch.from_numpy(drawing.known).to(view.observation.mask)
    return (crop(known[None], view.observation.window)[0] > 0.99).float() * view.observation.mask


def _texture(
    learnt: ObjectMap, seen: list[tuple[Keyframe, RenderedSide]], space: FeatureSpace | None, channels: int
) -> BackProjection:
    """What all sides together show of the feature texture, counted as a few views."""
    size, rest = learnt.texels.size, learnt.vertices
    total = BackProjection(rest.new_zeros(channels, size, size), rest.new_zeros(size, size))
    if space is None:
        return total
    for view, drawing in seen:
        observation = view.observation
        total = total + back_project(
            space.project(observation.features), _trusted_texture(view, drawing), rest, learnt.shape.faces,
            learnt.texels, view.pose.R, view.pose.translation, observation.K, learnt.renderer,
        )  # fmt: skip
    counted = _TEXTURE_WEIGHT * (total.weight > 0)
    return BackProjection(total.mean() * counted, counted)


def _without_pixels(observation: Observation, channels: int) -> Observation:
    """What is left of a drawn side once its texture and its points are taken: no state need keep its pixels."""
    point = observation.valid.new_zeros(1, 1)
    return replace(
        observation, image=point.expand(3, 1, 1).clone(), features=point.new_zeros(channels, 1, 1), valid=point,
        mask=point, distance=point, has_mask=False,
    )  # fmt: skip
