"""The online solver: track fast, map when it pays, and join matched points with re-rendering.

The first frames wait until the object has moved enough to be solved together (`waiting`, `start`); every further one
is tracked against the map (`tracking`) and judged (`judgement`), and enters the map where it shows a new view
(`growing`, `mapping`). When the video has ended, everything can be solved once more.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.correction import SIGHTED
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.framing import mask_box, projected_box
from tracking3d.estimation.observation import Observation, observe
from tracking3d.estimation.online.answers import solved, unsolved, with_colours
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import ONLINE_CLASSES, Belief, ObjectMap, View
from tracking3d.estimation.online.final_refinement import refined_once_more
from tracking3d.estimation.online.growing import refined, with_keyframe, with_points
from tracking3d.estimation.online.judgement import ENOUGH_POINTS, judge, looks_wrong, unexplained
from tracking3d.estimation.online.lens import through
from tracking3d.estimation.online.mapping import mask_weight, pose_of
from tracking3d.estimation.online.motion import carried, led_to, moved_on, predicted
from tracking3d.estimation.online.moving import moving_beside, with_past
from tracking3d.estimation.online.object_model import object_model
from tracking3d.estimation.online.points import FollowedPoints, follow, grey
from tracking3d.estimation.online.pose_refinement import PoseFit, PoseWeights
from tracking3d.estimation.online.reversal import turned_round
from tracking3d.estimation.online.sighting import meets, sighted
from tracking3d.estimation.online.start import Start
from tracking3d.estimation.online.steering import trusting, turned_back
from tracking3d.estimation.online.tracking import (
    agreeing,
    coast,
    fit_pose,
    pixel_scale,
    pose_of_points,
    searched,
    supported,
    worth_trying,
)
from tracking3d.estimation.online.waiting import solved_start, waiting_view
from tracking3d.estimation.shape import Shape
from tracking3d.estimation.solver import STATE_CLASSES
from tracking3d.estimation.start import first_mask, first_translation, mask_ellipse, prototype_mesh
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose, rotation_angle
from tracking3d.rendering import TexelMap
from tracking3d.stages import in_stage

_SPARSE = 40  # witnesses below which the map takes a frame for the sake of new points
_PAUSE = 3  # frames from one keyframe to the next for that sake
_FITS = 0.8  # overlap with the mask that lets a frame without witnesses into the map
_LOOKS_FLAT = (
    "all points seen so far lie in one plane; if the whole object is flat, --flat tells its back side better"
)
_TRAIL = 5  # believed frames that give the motion where nothing is seen


@dataclass(frozen=True)
class OnlineSolver:
    """See the module; implements `tracking3d.estimation.solver.Solver`, `RefiningSolver` and `SteeredSolver`.

    Attributes:
        config: The pipeline's configuration.
        camera: The camera of the full frame.
        encoder: The feature encoder.
    """

    config: PipelineConfig
    camera: Camera
    encoder: FeatureEncoder

    state_classes: ClassVar[tuple[type, ...]] = (*STATE_CLASSES, *ONLINE_CLASSES)
    """What a `Belief` is made of, for keeping it."""

    @property
    def online(self) -> OnlineConfig:
        """The solver's own part of the configuration."""
        assert isinstance(self.config.solver, OnlineConfig)
        return self.config.solver

    @property
    def weights(self) -> PoseWeights:
        """Weights of a pose's terms."""
        online = self.online
        return PoseWeights(appearance=online.appearance, outline=online.outline, points=online.points)

    @property
    def device(self) -> torch.device:
        """Where tensors live."""
        return torch.device(self.config.runtime.device)

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take the first frame, with the prototype as the shape.

        Raises:
            InputError: If the first frame's mask is missing or empty, or the prototype cannot be used.
        """
        binary = first_mask(frame, mask)
        ellipse = mask_ellipse(binary)
        translation = torch.tensor(first_translation(ellipse, self.camera), dtype=torch.float32)
        pose = Pose.identity(translation.to(self.device))
        shape = Shape.of(prototype_mesh(self.config.object, ellipse), self.config.object.flat, self.device)
        texels = TexelMap.of(shape.face_uvs, self.config.object.texture_size)
        known = ObjectMap(
            shape,
            texels,
            shape.rest,
            np.zeros((0, 3)),
            (),
            np.zeros(0, bool),
            renderer=self.config.runtime.renderer,
        )
        image = grey(frame.image)
        belief = Belief(self.camera, known, None, (pose, frame.index), None, image, FollowedPoints.none())
        observation = self._observe(belief, frame, binary, pose)
        channels = feature_channels(self.encoder, self.config.object.texture_channels)
        space = FeatureSpace.of(observation.features, observation.mask, channels)
        observation = replace(observation, features=space.project(observation.features))
        view = View(observation, binary, pose, FollowedPoints.none())
        known, view = with_points(known, self.camera, view, image)
        answer = unsolved(frame, binary, pose, self.camera)
        belief = replace(belief, known=known, space=space, followed=view.points, waiting=((view, answer),))
        return belief, answer

    def step(self, state: Belief, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take one more frame."""
        advance = self._track if state.waiting is None else self._wait
        return advance(state, frame, grey(frame.image), mask.found)

    turned_back = staticmethod(turned_back)
    trusting = staticmethod(trusting)

    def refine(self, state: Belief) -> Belief:
        """All keyframes together once more; where the start still waits, it is what the frames say so far."""
        if state.waiting is not None:
            state, start = solved_start(state, self.online, ended=True)
            if start is None:
                return state
            state, _ = self._begun(state, start)
        known, camera = refined_once_more(state.known, state.camera, self.online)
        return replace(
            state,
            camera=camera,
            known=known,
            surface=known.surface(),
            before=None,
            lost_for=0,
            doubted_for=0,
            followed=FollowedPoints.none(),
        )

    def revisit(
        self, state: Belief, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[Belief, FrameEstimate]:
        """A frame's pose once more, against the final map."""
        binary, image, known = mask.found, grey(frame.image), state.known
        causal = pose_of(T_cam_obj[:3, :3], T_cam_obj[:3, 3], known.vertices)
        if state.surface is None:
            return state, replace(unsolved(frame, binary, causal, state.camera), refined=True)
        starts = {"causal": causal}
        followed = follow(state.grey, image, state.followed)
        own = next((view for view in known.keyframes if view.index == frame.index), None)
        if own is not None:
            starts["keyframe"] = own.pose
            followed = own.points.joined(followed)
        if state.before is not None:
            starts |= predicted(state, frame.index)
        found = self._found(state, self._view(state, frame, binary, causal, followed), frame, image, starts)
        before = state.last if state.last[1] == frame.index - 1 else None
        belief = replace(moved_on(state, found, found.fit.pose, image), before=before)
        answer = solved(belief, unsolved(frame, binary, found.fit.pose, state.camera), found)
        return belief, replace(answer, refined=True)

    def result(self, state: Belief) -> ObjectModel:
        """The object with its visible texture back-projected from the keyframes."""
        known = state.known
        if not known.keyframes:
            known = replace(known, keyframes=tuple(view for view, _ in state.waiting or ()))
        return object_model(known, state.surface or known.surface())

    def _wait(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> tuple[Belief, FrameEstimate]:
        """Keep a first frame, and solve all of them once they can be."""
        assert state.waiting is not None
        pose = state.last[0]
        view = self._view(state, frame, mask, pose, follow(state.grey, image, state.followed))
        known, view = waiting_view(state.known, tuple(v for v, _ in state.waiting), view, image)
        answer = unsolved(frame, mask, pose, state.camera)
        belief = replace(state, known=known, waiting=(*state.waiting, (view, answer)))
        with in_stage("map"):
            belief, start = solved_start(belief.moved(pose, frame.index, image, view.points), self.online)
        if start is None:
            reason = belief.waits_for or answer.reason
            return belief, replace(answer, reason=reason)
        return self._begun(belief, start)

    def _begun(self, state: Belief, start: Start) -> tuple[Belief, FrameEstimate]:
        """Answer all waiting frames anew."""
        assert state.waiting is not None
        everything = list(range(len(start.known.keyframes)))
        waiting, before, camera = state.waiting, state.camera, start.camera
        with in_stage("map"):
            known = refined(start.known, camera, everything, self.online, bundle_iterations=20, rounds=3)
            belief = replace(state, camera=camera, known=known, surface=known.surface(), waiting=None)
        poses = {view.index: view.pose for view in known.keyframes}
        pose, usual, revised, trail = known.keyframes[0].pose, belief.usual, [], []
        for seen, earlier in waiting:
            view = through(seen, before, camera)
            start_pose = poses.get(view.index, pose)
            if known.pointless:
                view = replace(view, points=FollowedPoints.none(), mask_weight=1.0)
            fit = self._fit(belief, view, {start.origin: start_pose}, view.points)[1]
            if view.index == known.keyframes[0].index:
                fit = replace(fit, pose=start_pose)
            pose, usual = fit.pose, usual.updated(fit)
            trail.append((pose, view.index))
            kept = agreeing(known, camera, pose, view.points, view)
            support = supported(known, camera, pose, kept, view)
            found = Attempt(view, fit, start.origin, kept, support, judge(fit, usual, support))
            revised.append(solved(belief, earlier, found))
            belief = with_colours(belief, revised[-1], found)
        belief = replace(
            belief, last=trail[-1], before=trail[-2], trail=tuple(trail[-_TRAIL:]), usual=usual,
            followed=view.points,
        )  # fmt: skip
        answer = replace(revised[-1], revised=tuple(revised[:-1]))
        if start.origin == "flat" and not self.config.object.flat and not answer.reason:
            answer = replace(answer, reason=_LOOKS_FLAT)
        return belief, answer

    def _track(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> tuple[Belief, FrameEstimate]:
        """Find the frame's pose, and take it into the map where it shows something new."""
        starts = predicted(state, frame.index)
        likeliest = next(iter(starts.values()))
        followed = follow(state.grey, image, state.followed, carried(state, likeliest))
        found = self._found(state, self._view(state, frame, mask, likeliest, followed), frame, image, starts)
        key = not found.lost and self._is_keyframe(state, found)
        pose = coast(state.trail, frame.index) if found.lost else found.fit.pose
        belief = moved_on(state, found, pose, image)
        usual = not unexplained(found.fit, state.usual, found.view.mask_weight)
        if usual and not found.lost:
            belief = replace(belief, usual=state.usual.updated(found.fit))
        if key:
            view = replace(found.view, pose=pose, points=found.points)
            with in_stage("map"):
                known, followed = with_keyframe(state.known, state.camera, view, image, self.online)
                surface = known.surface()
                last = known.keyframes[-1].pose, frame.index
                belief = replace(belief, known=known, surface=surface, last=last, followed=followed)
                belief = turned_round(belief, self.online)
            pose = belief.last[0]
        if found.lost:
            belief = replace(belief, before=None)
        elif usual:
            belief = replace(belief, trail=(*belief.trail, (pose, frame.index))[-_TRAIL:])
        found = replace(found, fit=replace(found.fit, pose=pose))
        plain, now = unsolved(frame, mask, pose, state.camera), belief
        answer = solved(now, plain, found, lambda: moving_beside(now, found, image))
        belief = with_past(with_colours(belief, answer, found), answer, found, image)
        return belief, replace(answer, keyframe=key)

    def _found(
        self, state: Belief, view: View, frame: Frame, image: NDArray[np.uint8], starts: dict[str, Pose]
    ) -> Attempt:
        """The pose by cheap starts, by costly ones where it looks wrong, and elsewhere where none is believed."""
        assert state.surface is not None
        known, camera = state.known, state.camera
        on_object = view.points.only(~known.candidate[view.points.landmark])
        points = pose_of_points(known, camera, on_object, pixel_scale(view))
        if points is not None:
            starts = {**starts, "points": points[0]}
        won, fit = self._fit(state, view, starts, view.points)
        kept = agreeing(known, camera, fit.pose, view.points, view)
        support = supported(known, camera, fit.pose, kept, view)
        if state.lost_for or looks_wrong(fit, state.usual, support):
            won, fit, kept = searched(
                known, state.surface, camera, view, image, (won, fit, kept), self.weights, state.lost_for
            )
            support = supported(known, camera, fit.pose, kept, view)
        astray = state.lost_for > 0 and not led_to(state, fit.pose, frame.index)
        judgement = judge(fit, state.usual, support, won == "grid", astray)
        best = Attempt(view, fit, won, kept, support, judgement)
        if best.lost or (best.doubtful and worth_trying(state.doubted_for)):
            other = self._elsewhere(state, frame, image, view.mask)
            return other if other is not None and other.better_than(best) else best
        return best

    def _elsewhere(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Attempt | None:
        """The object somewhere else in the frame than the mask; None where it is not seen there either."""
        where = sighted(state.known, state.camera, image, state.trail[-1][0])
        if where is None:
            return None
        pose, points = where
        elsewhere = mask is None or not meets(state.known.silhouette(pose, state.camera), mask)
        view = self._view(state, frame, None if elsewhere else mask, pose, points)
        _, fit = self._fit(state, view, {SIGHTED: pose}, points)
        kept = agreeing(state.known, state.camera, fit.pose, points, view)
        support = supported(state.known, state.camera, fit.pose, kept, view)
        found = Attempt(view, fit, SIGHTED, kept, support, judge(fit, state.usual, support, guessed=True))
        return None if found.lost else found

    def _is_keyframe(self, state: Belief, found: Attempt) -> bool:
        """Whether the map has something to learn from a frame, and the frame can be relied on."""
        view, fit, agreed = found.view, found.fit, found.support.witnesses
        if view.mask is None or (agreed < ENOUGH_POINTS and fit.overlap < _FITS):
            return False
        keyframes = state.known.keyframes
        if agreed < _SPARSE and view.index >= keyframes[-1].index + _PAUSE:
            return True
        angles = [float(rotation_angle(other.pose.quaternion, fit.pose.quaternion)) for other in keyframes]
        return bool(np.degrees(min(angles)) > self.online.keyframe_rotation)

    def _fit(
        self, state: Belief, view: View, starts: dict[str, Pose], points: FollowedPoints
    ) -> tuple[str, PoseFit]:
        assert state.surface is not None
        return fit_pose(state.known, state.surface, view, starts, points, self.weights)

    def _view(
        self,
        state: Belief,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        pose: Pose,
        followed: FollowedPoints,
    ) -> View:
        """A frame as it is seen from a pose, with its mask judged by the points."""
        on_object = followed.only(~state.known.candidate[followed.landmark])
        observation = self._observe(state, frame, mask, pose)
        return View(observation, mask, pose, followed, mask_weight=mask_weight(mask, on_object))

    def _observe(
        self, state: Belief, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        box = mask_box(mask) if mask is not None else projected_box(state.known.vertices, state.camera, pose)
        if box is None:
            box = (0.0, 0.0, float(state.camera.width), float(state.camera.height))
        window = Window.around(box, self.config.window.margin, self.config.window.size)
        observation = observe(frame, mask, window, state.camera, self.encoder, self.device)
        if state.space is None:
            return observation
        return replace(observation, features=state.space.project(observation.features))
