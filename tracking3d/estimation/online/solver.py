"""The online solver: track fast, map when it pays, and join matched points with re-rendering.

The first frames wait until the object has moved enough to be solved together (`waiting`); every further one is
tracked against the map (`tracking`), and enters it where it shows a new view (`mapping`). When the video has ended,
everything can be solved once more (`revision`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.appearance import visible_texture
from tracking3d.estimation.assessment import Assessment
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.framing import mask_box, projected_box
from tracking3d.estimation.observation import Observation, observe
from tracking3d.estimation.online.answer_mask import answer_mask
from tracking3d.estimation.online.belief import Belief, ObjectMap, View
from tracking3d.estimation.online.judgement import ENOUGH_POINTS, judge, looks_wrong
from tracking3d.estimation.online.keypoints import detect
from tracking3d.estimation.online.mapping import (
    mask_weight,
    pose_of,
    project_points,
    refine_map,
    window_of,
    with_landmarks,
)
from tracking3d.estimation.online.points import (
    MOST_FOLLOWED,
    MOST_POINTS,
    FollowedPoints,
    follow,
    grey,
    new_corners,
)
from tracking3d.estimation.online.pose_refinement import PoseFit, PoseWeights
from tracking3d.estimation.online.recruits import recruit, with_candidates
from tracking3d.estimation.online.start import Start
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.estimation.online.tracking import (
    agreeing,
    coast,
    evidence,
    fit_pose,
    placed_keyframes,
    pose_of_points,
    rematched,
    turned_grid,
)
from tracking3d.estimation.online.waiting import solved_start, waiting_view
from tracking3d.estimation.shape import Shape
from tracking3d.estimation.start import first_translation, mask_ellipse, prototype_mesh
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose, extrapolate, rotation_angle
from tracking3d.rendering import BackProjection, TexelMap

_PASSES = 3
_SPARSE = 40  # witnesses below which the map takes a frame for the sake of new points
_TRAIL = 5  # believed frames that give the motion where nothing is seen
_FITS = 0.8  # overlap with the mask that lets a frame without witnesses into the map
_PAUSE = 3  # frames from one keyframe to the next for that sake
_WAITS = "the object has not moved enough yet to tell its shape"


@dataclass(frozen=True)
class OnlineSolver:
    """See the module; implements `tracking3d.estimation.solver.Solver` and `RefiningSolver`.

    Attributes:
        config: The pipeline's configuration.
        camera: The camera of the full frame.
        encoder: The feature encoder.
    """

    config: PipelineConfig
    camera: Camera
    encoder: FeatureEncoder
    fit: FitWeights = field(default_factory=FitWeights)
    weights: PoseWeights = field(default_factory=PoseWeights)
    prior: float = 20.0
    keyframe_angle: float = 8.0
    map_window: int = 12

    @property
    def device(self) -> torch.device:
        """Where tensors live."""
        return torch.device(self.config.runtime.device)

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take the first frame, with the prototype as the shape.

        Raises:
            InputError: If the first frame's mask is missing or empty, or the prototype cannot be used.
        """
        started = time.perf_counter()
        binary = mask.binary
        if binary is None or not binary.any():
            raise InputError(
                f"{frame.name or 'The first frame'} has no object: its mask is empty; give another box or mask."
            )
        ellipse = mask_ellipse(binary)
        translation = torch.tensor(first_translation(ellipse, self.camera), dtype=torch.float32)
        pose = Pose.identity(translation.to(self.device))
        shape = Shape.of(prototype_mesh(self.config.object, ellipse), self.config.object.flat, self.device)
        texels = TexelMap.of(shape.face_uvs, self.config.object.texture_size)
        known = ObjectMap(
            shape, texels, shape.rest, np.zeros((0, 3)), (), np.zeros(0, bool), self.config.runtime.renderer
        )
        image = grey(frame.image)
        belief = Belief(self.camera, known, None, (pose, frame.index), None, image, FollowedPoints.none())
        observation = self._observe(belief, frame, binary, pose)
        channels = feature_channels(self.encoder, self.config.object.texture_channels)
        belief = replace(belief, space=FeatureSpace.of(observation.features, observation.mask, channels))
        assert belief.space is not None
        observation = replace(observation, features=belief.space.project(observation.features))
        view = View(observation, binary, pose, FollowedPoints.none())
        known, view = with_candidates(*self._named(known, view, image), image)
        answer = self._unsolved(frame, binary, pose, started)
        return replace(belief, known=known, followed=view.points, waiting=((view, answer),)), answer

    def step(self, state: Belief, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take one more frame."""
        started = time.perf_counter()
        binary = mask.binary
        if binary is not None and not binary.any():
            binary = None
        image = grey(frame.image)
        if state.waiting is not None:
            return self._wait(state, frame, image, binary, started)
        return self._track(state, frame, image, binary, started)

    def refine(self, state: Belief) -> Belief:
        """All keyframes together once more."""
        known = state.known
        if state.waiting is not None:
            return state
        everything = list(range(len(known.keyframes)))
        for _ in range(_PASSES):
            known = recruit(known, self.camera, everything)
            known = refine_map(
                known, self.camera, everything, weights=self.fit, prior=self.prior, bundle_iterations=15, rounds=2
            )
        return replace(state, known=known, surface=known.surface(), before=None, followed=FollowedPoints.none())

    def revisit(
        self, state: Belief, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[Belief, FrameEstimate]:
        """A frame's pose once more, against the final map."""
        started = time.perf_counter()
        binary = mask.binary
        if binary is not None and not binary.any():
            binary = None
        known, image = state.known, grey(frame.image)
        causal = pose_of(T_cam_obj[:3, :3], T_cam_obj[:3, 3], known.vertices)
        if state.surface is None:
            return state, replace(self._unsolved(frame, binary, causal, started), refined=True)
        starts = {"causal": causal}
        followed = follow(state.grey, image, state.followed) if len(state.followed) else state.followed
        own = next((view for view in known.keyframes if view.index == frame.index), None)
        if own is not None:
            starts["keyframe"] = own.pose
            followed = own.points.joined(followed)
        if state.before is not None:
            starts |= self._predicted(state, frame.index)
        on_object = followed.only(~known.candidate[followed.landmark])
        view = View(
            self._observe(state, frame, binary, causal), binary, causal, followed,
            mask_weight=mask_weight(binary, on_object),
        )  # fmt: skip
        points = pose_of_points(known, self.camera, on_object, view)
        if points is not None:
            starts["points"] = points[0]
        won, fit = self._fit(state, view, starts, followed)
        kept = agreeing(known, self.camera, fit.pose, followed, view)
        if looks_wrong(fit, state.usual, self._witnesses(known, kept), view.mask_weight):
            won, fit, kept = self._searched(state, view, image, (won, fit, kept))
        witnesses = self._witnesses(known, kept)
        judgement = judge(fit, state.usual, witnesses, view.mask_weight, binary is not None)
        belief = state.moved(fit.pose, frame.index, image, kept)
        belief = replace(belief, before=state.last if state.last[1] == frame.index - 1 else None, status=judgement.status)
        answer = self._answered(belief, self._unsolved(frame, binary, fit.pose, started), view, fit, won, witnesses)
        return belief, self._judged(answer, judgement, binary, started)

    def _judged(
        self, answer: FrameEstimate, judgement: Assessment, mask: NDArray[np.bool_] | None, started: float
    ) -> FrameEstimate:
        hidden = mask if mask is not None else np.zeros_like(answer.mask)
        return replace(
            answer,
            status=judgement.status,
            reason=judgement.reason,
            confidence=judgement.confidence,
            mask=hidden if judgement.status is Status.LOST else answer.mask,
            seconds=time.perf_counter() - started,
            refined=True,
        )

    def result(self, state: Belief) -> ObjectModel:
        """The object with its visible texture back-projected from the keyframes."""
        known = state.known
        keyframes = known.keyframes or tuple(view for view, _ in state.waiting or ())
        size = known.texels.size
        seen = BackProjection(known.vertices.new_zeros(3, size, size), known.vertices.new_zeros(size, size))
        for view in keyframes:
            seen = seen + known.back_project(view.observation.image, view)
        texture, weight = visible_texture(seen)
        surface = state.surface or replace(known, keyframes=keyframes).surface()
        return ObjectModel(
            known.vertices.double().cpu().numpy(),
            known.shape.faces.cpu().numpy(),
            known.shape.face_uvs.double().cpu().numpy(),
            texture,
            weight,
            surface.texture.permute(1, 2, 0).cpu().numpy(),
        )

    def _wait(
        self,
        state: Belief,
        frame: Frame,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        started: float,
    ) -> tuple[Belief, FrameEstimate]:
        """Keep a first frame, and solve all of them once they can be."""
        assert state.waiting is not None
        pose = state.last[0]
        followed = follow(state.grey, image, state.followed)
        weight = mask_weight(mask, followed.only(~state.known.candidate[followed.landmark]))
        view = View(self._observe(state, frame, mask, pose), mask, pose, followed, mask_weight=weight)
        known, view = waiting_view(state.known, tuple(v for v, _ in state.waiting), view, image)
        answer = self._unsolved(frame, mask, pose, started)
        belief = replace(state, known=known, waiting=(*state.waiting, (view, answer)))
        belief = belief.moved(pose, frame.index, image, view.points)
        belief, start = solved_start(belief, self.fit, self.prior)
        if start is None:
            return belief, answer
        return self._begun(belief, start, started)

    def _begun(self, state: Belief, start: Start, started: float) -> tuple[Belief, FrameEstimate]:
        """Answer all waiting frames anew."""
        assert state.waiting is not None
        known = start.known
        everything = list(range(len(known.keyframes)))
        known = recruit(known, self.camera, everything)
        known = refine_map(
            known, self.camera, everything, weights=self.fit, prior=self.prior, rounds=3, bundle_iterations=20
        )
        belief = replace(state, known=known, surface=known.surface(), waiting=None)
        solved = {view.index: view.pose for view in known.keyframes}
        pose, usual, revised, poses = known.keyframes[0].pose, belief.usual, [], []
        for view, earlier in state.waiting:
            name, pose = start.origin, solved.get(view.index, pose)
            fit = self._fit(belief, view, {name: pose}, view.points)[1]
            if view.index != known.keyframes[0].index:
                pose = fit.pose
            usual = usual.updated(fit)
            poses.append((pose, view.index))
            revised.append(self._answered(belief, earlier, view, replace(fit, pose=pose), name))
        belief = replace(belief, last=poses[-1], before=poses[-2], trail=tuple(poses[-_TRAIL:]), usual=usual, status=Status.TRACKED)
        seconds = time.perf_counter() - started
        return belief, replace(revised[-1], revised=tuple(revised[:-1]), seconds=seconds)

    def _track(
        self,
        state: Belief,
        frame: Frame,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        started: float,
    ) -> tuple[Belief, FrameEstimate]:
        """Find the frame's pose, and take it into the map where it shows something new."""
        known = state.known
        starts = self._predicted(state, frame.index)
        predicted = next(iter(starts.values()))
        followed = follow(state.grey, image, state.followed, self._carried(state, predicted))
        on_object = followed.only(~known.candidate[followed.landmark])
        view = View(
            self._observe(state, frame, mask, predicted), mask, predicted, followed,
            mask_weight=mask_weight(mask, on_object),
        )  # fmt: skip
        points = pose_of_points(known, self.camera, on_object, view)
        if points is not None:
            starts["points"] = points[0]
        won, fit = self._fit(state, view, starts, followed)
        kept = agreeing(known, self.camera, fit.pose, followed, view)
        if state.status is Status.LOST or looks_wrong(fit, state.usual, self._witnesses(known, kept), view.mask_weight):
            won, fit, kept = self._searched(state, view, image, (won, fit, kept))
        witnesses = self._witnesses(known, kept)
        judgement = judge(fit, state.usual, witnesses, view.mask_weight, mask is not None)
        view = replace(view, pose=fit.pose, points=kept)
        lost = judgement.status is Status.LOST
        belief = state.moved(fit.pose, frame.index, image, kept)
        belief = replace(belief, status=judgement.status)
        if lost:
            coasting = coast(state.trail, frame.index)
            fit = replace(fit, pose=coasting)
            belief = replace(belief, last=(coasting, frame.index), before=None)
        else:
            belief = replace(belief, trail=(*state.trail, (fit.pose, frame.index))[-_TRAIL:])
            if judgement.status is Status.TRACKED:
                belief = replace(belief, usual=state.usual.updated(fit))
        sparse = witnesses < _SPARSE and frame.index >= known.keyframes[-1].index + _PAUSE
        sure = witnesses >= ENOUGH_POINTS or fit.overlap > _FITS
        key = not lost and sure and mask is not None and (sparse or self._is_new(known, fit.pose))
        if key:
            belief = self._mapped(belief, view, image)
            fit = replace(fit, pose=belief.last[0])
        answer = self._unsolved(frame, mask, fit.pose, started)
        answer = self._answered(belief, answer, view, fit, won, witnesses)
        answer = replace(
            answer,
            status=judgement.status,
            reason=judgement.reason,
            confidence=judgement.confidence,
            keyframe=key,
            seconds=time.perf_counter() - started,
        )
        if lost:
            answer = replace(answer, mask=mask if mask is not None else np.zeros(frame.size, dtype=np.bool_))
        return belief, answer

    def _searched(
        self, state: Belief, view: View, image: NDArray[np.uint8], best: tuple[str, PoseFit, FollowedPoints]
    ) -> tuple[str, PoseFit, FollowedPoints]:
        """The best of what is known and of the costly hypotheses, by what re-renders the frame."""
        assert state.surface is not None
        known, lost = state.known, state.status is Status.LOST
        tried = [best]
        for pose, points in rematched(known, self.camera, replace(view, pose=best[1].pose), image, lost):
            _, fit = self._fit(state, view, {"keyframe": pose}, points)
            tried.append(("keyframe", fit, agreeing(known, self.camera, fit.pose, points, view)))
        if view.mask is not None:
            centre = best[1].pose
            if lost:
                placed = {str(n): pose for n, pose in enumerate(placed_keyframes(known, self.camera, view))}
                centre = self._fit(state, view, placed, FollowedPoints.none())[1].pose
            for pose in turned_grid(state.surface, view, centre, self.weights):
                _, fit = self._fit(state, view, {"grid": pose}, FollowedPoints.none())
                points = agreeing(known, self.camera, fit.pose, view.points, view)
                tried.append(("grid", fit, points))
        return min(
            tried,
            key=lambda one: evidence(one[1], self.weights, view.mask_weight)
            - 0.005 * min(self._witnesses(known, one[2]), 30),
        )

    def _mapped(self, state: Belief, view: View, image: NDArray[np.uint8]) -> Belief:
        """With the view as a new keyframe."""
        known, view = with_candidates(*self._named(state.known, view, image), image)
        known = replace(known, keyframes=(*known.keyframes, view))
        window = window_of(len(known.keyframes), self.map_window)
        known = recruit(known, self.camera, window)
        known = refine_map(known, self.camera, window, weights=self.fit, prior=self.prior)
        newest = known.keyframes[-1]
        followed = newest.points.spread(MOST_FOLLOWED, float(view.observation.window.side))
        return replace(
            state, known=known, surface=known.surface(), last=(newest.pose, view.index), followed=followed
        )

    def _predicted(self, state: Belief, index: int) -> dict[str, Pose]:
        """Poses to start from, by name."""
        last, last_index = state.last
        if state.status is Status.LOST and state.trail:
            return {"coasting": coast(state.trail, index), "last": state.trail[-1][0]}
        if state.before is None:
            return {"last": last}
        before, before_index = state.before
        steps = (index - last_index) / max(last_index - before_index, 1)
        return {"velocity": extrapolate(before, last, min(steps, 3.0)), "last": last}

    def _carried(self, state: Belief, predicted: Pose) -> NDArray[np.float32] | None:
        """``(N, 2)`` where the points should be at a predicted pose."""
        if not len(state.followed):
            return None
        position = state.known.landmarks[state.followed.landmark]
        shift = project_points(position, predicted, self.camera) - project_points(
            position, state.last[0], self.camera
        )
        return np.asarray(state.followed.pixel + np.nan_to_num(shift), dtype=np.float32)

    def _is_new(self, known: ObjectMap, pose: Pose) -> bool:
        """Whether no keyframe shows the object like this."""
        angles = [float(rotation_angle(view.pose.quaternion, pose.quaternion)) for view in known.keyframes]
        return bool(np.degrees(min(angles)) > self.keyframe_angle)

    @staticmethod
    def _witnesses(known: ObjectMap, points: FollowedPoints) -> int:
        """How many of the points are landmarks that two keyframes have seen."""
        return int((known.sightings[points.landmark] >= 2).sum())

    def _fit(
        self, state: Belief, view: View, starts: dict[str, Pose], points: FollowedPoints
    ) -> tuple[str, PoseFit]:
        assert state.surface is not None
        return fit_pose(state.known, state.surface, view, starts, points, self.weights)

    def _named(self, known: ObjectMap, view: View, image: NDArray[np.uint8]) -> tuple[ObjectMap, View]:
        """With landmarks at keypoints and corners."""
        inside = view.mask if view.mask is not None else known.silhouette(view.pose, self.camera)
        keypoints = detect(image, inside)
        taken = np.concatenate([view.points.pixel, keypoints.pixel])
        corners = new_corners(image, inside, taken, MOST_POINTS)
        return with_landmarks(known, self.camera, view, keypoints, corners)

    def _observe(
        self, belief: Belief, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        box = (
            mask_box(mask) if mask is not None else projected_box(belief.known.vertices, self.camera, pose)
        )
        if box is None:
            box = (0.0, 0.0, float(self.camera.width), float(self.camera.height))
        window = Window.around(box, self.config.window.margin, self.config.window.size)
        observation = observe(frame, mask, window, self.camera, self.encoder, self.device)
        if belief.space is None:
            return observation
        return replace(observation, features=belief.space.project(observation.features))

    def _answered(
        self, state: Belief, answer: FrameEstimate, view: View, fit: PoseFit, won: str, witnesses: int = 0
    ) -> FrameEstimate:
        """An answer with a pose and what it renders."""
        return replace(
            answer,
            T_cam_obj=fit.pose.matrix().numpy(),
            mask=answer_mask(
                state.known.silhouette(fit.pose, self.camera),
                view.mask,
                state.usual,
                view.mask_weight,
                witnesses >= ENOUGH_POINTS,
            ),
            status=Status.TRACKED,
            reason="",
            confidence=0.6,
            hypothesis=won,
            iterations=fit.iterations,
            losses={
                "features": fit.appearance,
                "outline": fit.outline,
                "points": fit.points,
                "overlap": fit.overlap,
                "unseen": fit.unseen,
                "witnesses": float(witnesses),
                "mask_weight": view.mask_weight,
            },
        )

    def _unsolved(
        self, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose, started: float
    ) -> FrameEstimate:
        """The answer while nothing is known: the initial mask."""
        return FrameEstimate(
            index=frame.index,
            time=frame.time,
            T_cam_obj=pose.matrix().numpy(),
            mask=mask if mask is not None else np.zeros(frame.size, dtype=np.bool_),
            initial_mask=mask,
            status=Status.UNCERTAIN,
            reason=_WAITS,
            confidence=0.3,
            seconds=time.perf_counter() - started,
        )
