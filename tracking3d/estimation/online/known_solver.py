"""The online solver for an object that is known: it is looked for instead of got to know, and then tracked as any."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, argument
from tracking3d.estimation.correction import SIGHTED
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.known_object import KnownObject
from tracking3d.estimation.online.answers import solved, unsolved, with_colours
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief
from tracking3d.estimation.online.growing import with_keyframe
from tracking3d.estimation.online.judgement import judge
from tracking3d.estimation.online.known_search import by_keypoints, by_outline
from tracking3d.estimation.online.known_views import known_map
from tracking3d.estimation.online.points import FollowedPoints, grey
from tracking3d.estimation.online.sighting import meets
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.steering import turned_back
from tracking3d.estimation.online.tracking import agreeing, standing, supported, worth_trying
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.pose import Pose
from tracking3d.stages import in_stage

NOT_SEEN = "the known object has not been seen yet"
_OUTLINED = "outline"
_ENOUGH_ALONE, _MOSTLY_SEEN = 30, 0.5
"""Points that tell a first pose without a mask, and the share of unseen texture below which they do."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class KnownObjectSolver(OnlineSolver):
    """Tracks what is known; answers are in the object's own coordinates and unit.

    Until the object is found in a frame, frames are answered as lost, and each is searched. From then on it is the
    online solver, on a map whose shape is held.

    Attributes:
        known_object: The object.
    """

    known_object: KnownObject

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
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
        with in_stage("map"):
            known, space = known_map(known_object, self.config, self.encoder, self.device)
        pose = Pose.identity(known.vertices.new_tensor([0.0, 0.0, 4 * self.camera.fy / self.camera.height]))
        belief = Belief(
            self.camera, known, known.surface(), (pose, frame.index), None, grey(frame.image),
            FollowedPoints.none(), None, space,
        )  # fmt: skip
        belief, answer = self._sought(belief, frame, binary)
        return belief, known_object.answered(answer)

    def step(self, state: Belief, frame: Frame, mask: MaskEstimate) -> tuple[Belief, FrameEstimate]:
        """Take one more frame."""
        if state.trail:
            state, answer = super().step(state, frame, mask)
        else:
            state, answer = self._sought(state, frame, mask.found)
        return state, self.known_object.answered(answer)

    def revisit(
        self, state: Belief, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[Belief, FrameEstimate]:
        """A frame's pose once more, with all that the video has shown."""
        if not state.trail:
            answer = _unseen(unsolved(frame, mask.found, state.last[0], state.camera))
            return state, self.known_object.answered(replace(answer, refined=True))
        causal = self.known_object.to_solver(T_cam_obj)
        state, answer = super().revisit(state, frame, mask, causal)
        return state, self.known_object.answered(answer)

    def turned_back(self, state: Belief, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]) -> Belief:
        """The belief that goes on from a frame seen long ago; see `steering.turned_back`."""
        turned = turned_back(state, frame, number, self.known_object.to_solver(T_cam_obj))
        return turned if state.trail else replace(turned, trail=())

    def result(self, state: Belief) -> ObjectModel:
        """The object as it is known."""
        assert state.surface is not None
        features = state.surface.texture.permute(1, 2, 0).cpu().numpy()
        return replace(self.known_object.model, features=features)

    def _sought(
        self, state: Belief, frame: Frame, mask: NDArray[np.bool_] | None
    ) -> tuple[Belief, FrameEstimate]:
        """Look for the object in a frame, and begin with it where it is found."""
        image = grey(frame.image)
        state = self._with_space(state, frame, mask)
        found = self._met(state, frame, image, mask)
        if found is None or found.lost or _too_little(found):
            answer = _unseen(unsolved(frame, mask, state.last[0], state.camera), found)
            pose = state.last[0]
            missing = replace(state, last=(pose, frame.index), grey=image, lost_for=state.lost_for + 1)
            return missing, answer
        pose = found.fit.pose
        begun = replace(
            state, last=(pose, frame.index), before=None, grey=image, followed=found.points, lost_for=0,
            doubted_for=int(found.doubtful), trail=((pose, frame.index),), usual=state.usual.updated(found.fit),
        )  # fmt: skip
        answer = solved(begun, unsolved(frame, mask, pose, state.camera), found)
        # What is not sure must not become what later frames are held against, where there is something better.
        if not found.doubtful or not self.known_object.has_colours:
            view = replace(found.view, pose=pose, points=found.points)
            with in_stage("map"):
                known, followed = with_keyframe(state.known, state.camera, view, image, self.online)
                begun = replace(begun, known=known, surface=known.surface(), followed=followed)
            answer = replace(answer, keyframe=True)
        return with_colours(begun, answer, found), answer

    def _met(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Attempt | None:
        """The object in a frame of which nothing else is known; None where nothing looks like it."""
        attempts: list[Attempt] = []
        for region in (mask, None) if mask is not None else (None,):
            if self.known_object.has_colours and not _sure(attempts):
                attempts += [
                    self._attempt(state, frame, mask, SIGHTED, pose, points)
                    for pose, points in by_keypoints(state.known, state.camera, image, region)
                ]
        if mask is not None and not _sure(attempts) and worth_trying(state.lost_for):
            assert state.surface is not None
            view = self._view(state, frame, mask, state.last[0], FollowedPoints.none())
            attempts += [
                self._attempt(state, frame, mask, _OUTLINED, pose, FollowedPoints.none())
                for pose in by_outline(state.surface, state.camera, view, self.weights)
            ]
        believed = [one for one in attempts if not one.lost] or attempts
        return min(
            believed,
            key=lambda one: standing(one.fit, self.weights, one.view.mask_weight, one.support.witnesses),
            default=None,
        )

    def _attempt(
        self,
        state: Belief,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        origin: str,
        pose: Pose,
        points: FollowedPoints,
    ) -> Attempt:
        """What comes of a pose that was found in some way."""
        known, camera = state.known, state.camera
        if mask is not None and not meets(known.silhouette(pose, camera), mask):
            mask = None
        view = self._view(state, frame, mask, pose, points)
        _, fit = self._fit(state, view, {origin: pose}, points)
        kept = agreeing(known, camera, fit.pose, points, view)
        support = supported(known, camera, fit.pose, kept, view)
        judgement = judge(fit, state.usual, support, guessed=origin == _OUTLINED)
        return Attempt(view, fit, origin, kept, support, judgement)

    def _with_space(self, state: Belief, frame: Frame, mask: NDArray[np.bool_] | None) -> Belief:
        """The belief with the features of an object whose colours the first frame with a mask tells first."""
        if state.space is not None or mask is None or not mask.any():
            return state
        seen = self._observe(state, frame, mask, state.last[0])
        channels = feature_channels(self.encoder, self.config.object.texture_channels)
        return replace(state, space=FeatureSpace.of(seen.features, seen.mask, channels))

    def _warn_of_lens(self) -> None:
        """Tell the log where the lens is assumed though the object was learnt with another."""
        earlier = self.known_object.camera
        if self.camera.assumed and earlier is not None and earlier.known:
            _log.warning(
                "%s was learnt with a lens of %.1f degrees in pictures of %d x %d pixels, not %d x %d; its lens is "
                "not taken over, and 45 degrees are assumed. Give the lens of this video.",
                self.known_object.name.capitalize(), earlier.fov, earlier.width, earlier.height,
                self.camera.width, self.camera.height,
            )  # fmt: skip


def _sure(attempts: list[Attempt]) -> bool:
    return any(not one.doubtful for one in attempts)


def _too_little(found: Attempt) -> bool:
    """Whether a few points alone say where it is: no mask bears them out, and they may lie in one spot."""
    enough = found.support.witnesses >= _ENOUGH_ALONE and found.fit.unseen < _MOSTLY_SEEN
    return found.view.mask is None and found.doubtful and not enough


def _unseen(answer: FrameEstimate, found: Attempt | None = None) -> FrameEstimate:
    """The answer while the object has not been seen, and what spoke most against what was found."""
    why = "" if found is None or not found.view.observation.has_mask else f": {found.judgement.reason}"
    return replace(answer, status=Status.LOST, reason=NOT_SEEN + why, confidence=0.05)
