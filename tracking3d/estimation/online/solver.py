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

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.online.anew import (
    adopted,
    believable,
    doubted,
    guess,
    in_place,
    is_whole,
    joined,
    largest_of,
    looks_alike,
    of_frame,
    of_one_thing,
    refined_aside,
    turned_to,
)
from tracking3d.estimation.online.answers import solved, unsolved, with_colours
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import ONLINE_CLASSES, Belief, ObjectMap, View
from tracking3d.estimation.online.final_refinement import refined_once_more
from tracking3d.estimation.online.finding import PoseFinder
from tracking3d.estimation.online.growing import refined, with_keyframe, with_points
from tracking3d.estimation.online.judgement import ENOUGH_POINTS, judge, unexplained
from tracking3d.estimation.online.lens import through
from tracking3d.estimation.online.mapping import pose_of
from tracking3d.estimation.online.motion import carried, moved_on, predicted
from tracking3d.estimation.online.moving import moving_beside, with_past
from tracking3d.estimation.online.object_model import object_model
from tracking3d.estimation.online.points import FollowedPoints, follow, grey
from tracking3d.estimation.online.reversal import turned_round
from tracking3d.estimation.online.start import InitialMap
from tracking3d.estimation.online.steering import trusting, turned_back
from tracking3d.estimation.online.tracking import (
    agreeing,
    coast,
    supported,
    worth_trying,
)
from tracking3d.estimation.online.waiting import solved_start, waiting_view
from tracking3d.estimation.shape import Shape
from tracking3d.estimation.solver import STATE_CLASSES
from tracking3d.estimation.start import first_mask, first_translation, mask_ellipse, prototype_mesh
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
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
class OnlineSolver(PoseFinder):
    """See the module; implements `tracking3d.estimation.solver.Solver`, `RefiningSolver` and `SteeredSolver`."""

    state_classes: ClassVar[tuple[type, ...]] = (*STATE_CLASSES, *ONLINE_CLASSES)
    """What a `Belief` is made of, for keeping it."""

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take the first frame, with the prototype as the shape.

        Raises:
            InputError: If the first frame's mask is missing or empty, or the prototype cannot be used.
        """
        return self._first(frame, first_mask(frame, mask), self.camera)

    def _first(
        self, frame: Frame, binary: NDArray[np.bool_], camera: Camera, space: FeatureSpace | None = None
    ) -> tuple[Belief, FrameEstimate]:
        """Take a first frame; ``space`` is that of the features, where there is one."""
        ellipse = mask_ellipse(binary)
        translation = torch.tensor(first_translation(ellipse, camera), dtype=torch.float32)
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
        belief = Belief(camera, known, None, (pose, frame.index), None, image, FollowedPoints.none())
        observation = self._observe(belief, frame, binary, pose)
        if space is None:
            channels = feature_channels(self.encoder, self.config.object.texture_channels)
            space = FeatureSpace.of(observation.features, observation.mask, channels)
        observation = replace(observation, features=space.project(observation.features))
        view = View(observation, binary, pose, FollowedPoints.none())
        known, view = with_points(known, camera, view, image)
        answer = unsolved(frame, binary, pose, camera)
        belief = replace(belief, known=known, space=space, followed=view.points, waiting=((view, answer),))
        return belief, answer

    def step(self, state: Belief, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take one more frame."""
        binary = mask.found
        if state.waiting is not None:
            return self._wait(state, frame, grey(frame.image), binary)
        state, answer = self._track(state, frame, grey(frame.image), binary)
        may_begin_anew = not state.known.held and not state.known.pointless
        if answer.status is Status.LOST and binary is not None and may_begin_anew:
            state, answer = self._otherwise(state, answer, frame, binary)
        return state, doubted(answer) if state.guessed else answer

    turned_back = staticmethod(turned_back)
    trusting = staticmethod(trusting)

    def refine(self, state: Belief) -> Belief:
        """All keyframes together once more; where the start still waits, it is what the frames say so far."""
        if state.waiting is not None:
            state, start = solved_start(state, self.online, ended=True)
            if start is None:
                return state
            state, _ = self._begun(state, start)
        state = joined(state, self.online, state.known.keyframes)
        state = largest_of(replace(state, spans=(*state.spans, (state.since, state.last[1]))))
        known, camera = refined_once_more(state.known, state.camera, self.online)
        return replace(
            state,
            aside=tuple(refined_aside(other, state.camera, camera, self.online) for other in state.aside),
            guessed=False,
            camera=camera,
            known=known,
            surface=known.surface(),
            before=None,
            lost_for=0,
            doubted_for=0,
            trail=state.trail and ((known.keyframes[0].pose, known.keyframes[0].index),),
            followed=FollowedPoints.none(),
        )

    def revisit(
        self, state: Belief, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[Belief, FrameEstimate]:
        """A frame's pose once more, against the final map."""
        state = of_frame(state, frame.index)
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
            starts |= predicted(state, frame.index, binary)
        found = self._found(state, self._view(state, frame, binary, causal, followed), frame, image, starts)
        before = state.last if state.last[1] == frame.index - 1 else None
        belief = replace(moved_on(state, found, found.fit.pose, image), before=before)
        if not found.lost:
            belief = replace(belief, trail=(*state.trail, (found.fit.pose, frame.index))[-_TRAIL:])
        if found.lost:  # no pose was found that would be better than where it was taken to be
            found = replace(found, fit=replace(found.fit, pose=causal))
        answer = solved(belief, unsolved(frame, binary, found.fit.pose, state.camera), found)
        return belief, replace(doubted(answer) if state.guessed else answer, refined=True)

    def result(self, state: Belief) -> ObjectModel:
        """The object with its visible texture back-projected from the keyframes."""
        if state.aside:
            state = largest_of(state)
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

    def _begun(self, state: Belief, start: InitialMap) -> tuple[Belief, FrameEstimate]:
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
        starts = predicted(state, frame.index, mask)
        likeliest = next(iter(starts.values()))
        followed = follow(state.grey, image, state.followed, carried(state, likeliest))
        found = self._found(state, self._view(state, frame, mask, likeliest, followed), frame, image, starts)
        usual = not unexplained(found.fit, state.usual, found.view.mask_weight)
        key = not found.lost and (usual or found.support.settles) and self._is_keyframe(state, found)
        pose = coast(state.trail, frame.index) if found.lost else found.fit.pose
        belief = moved_on(state, found, pose, image)
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
                belief = joined(belief, self.online, belief.known.keyframes[-1:])
            pose = belief.last[0]
        if found.lost:
            belief = replace(belief, before=None)
        elif usual:
            belief = replace(belief, trail=(*belief.trail, (pose, frame.index))[-_TRAIL:])
        found = replace(found, fit=replace(found.fit, pose=pose))
        plain, now = unsolved(frame, mask, pose, state.camera), belief
        answer = solved(now, plain, found, lambda: moving_beside(now, found, image))
        belief = with_past(with_colours(belief, answer, found), answer, found, image)
        if not found.lost:
            belief = replace(belief, anew=None)
        return belief, replace(answer, keyframe=key)

    def _otherwise(
        self, state: Belief, answer: FrameEstimate, frame: Frame, mask: NDArray[np.bool_]
    ) -> tuple[Belief, FrameEstimate]:
        """A lost object by another map that knows this side of it, or by a second start; see `anew`.

        Args:
            state: After the frame, in which the object is lost.
            answer: To it.
            frame: The frame.
            mask: ``(H, W)`` its initial mask.
        """
        image = grey(frame.image)
        for other in state.aside if worth_trying(state.lost_for) else ():
            belief, found = self._track(turned_to(state, other, frame.index), frame, image, mask)
            if found.losses["witnesses"] >= ENOUGH_POINTS and found.status is not Status.LOST:
                return belief, found
        begun, last = state.anew, None
        if begun is not None and begun.waiting:
            last = begun.waiting[-1][0].mask
        if begun is None or not of_one_thing(last, mask):
            if not is_whole(mask) or not looks_alike(state, frame, mask):
                return replace(state, anew=None), answer
            camera = replace(state.camera, assumed=False)
            return replace(state, anew=self._first(frame, mask, camera, state.space)[0]), answer
        begun, again = self._wait(begun, frame, image, mask)
        if begun.waiting is not None:
            return replace(state, anew=begun), answer
        if not believable(begun, again):
            return replace(state, anew=None), answer
        similarity = guess(state, begun)
        return adopted(state, begun, similarity), in_place(again, similarity, state.camera)

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
