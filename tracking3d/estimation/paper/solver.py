"""The solver of Rozumnyi et al., ICCV 2023, sections 3.1 to 3.4, and what the presets add to it.

In every frame one Adam optimizes the poses of the keyframes and of the new frame, the shape and the texture.
The gauge is fixed: the oldest frame in the window does not move. Where a config key is not the paper's, its
default is, so that preset ``paper`` is the pure recipe.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.solvers import PaperConfig
from tracking3d.estimation.appearance import visible_texture
from tracking3d.estimation.assessment import Assessment, assess
from tracking3d.estimation.estimate import FrameEstimate, MaskSource, ObjectModel, Status
from tracking3d.estimation.feature_space import TAU, FeatureSpace, feature_channels
from tracking3d.estimation.keyframes import KeyframeCandidate, is_new_view, select_keyframes
from tracking3d.estimation.observation import Observation, ObservationBatch
from tracking3d.estimation.paper.belief import PaperState, PosedObservation
from tracking3d.estimation.paper.joint_start import joint_start
from tracking3d.estimation.paper.optimize import Optimum, optimize
from tracking3d.estimation.paper.prediction import candidate_poses
from tracking3d.estimation.paper.problem import Problem
from tracking3d.estimation.shape import Shape
from tracking3d.estimation.solver import STATE_CLASSES
from tracking3d.estimation.solver_base import SolverBase
from tracking3d.estimation.start import first_mask, first_translation, mask_ellipse, prototype_mesh
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import BackProjection, TexelMap
from tracking3d.stages import in_stage


@dataclass(frozen=True)
class PaperSolver(SolverBase):
    """See the module; implements `tracking3d.estimation.solver.Solver`."""

    state_classes: ClassVar[tuple[type, ...]] = (*STATE_CLASSES, PaperState, PosedObservation)
    """What a `PaperState` is made of, for keeping it."""

    @property
    def settings(self) -> PaperConfig:
        """The solver's own part of the configuration."""
        assert isinstance(self.config.solver, PaperConfig)
        return self.config.solver

    @property
    def tau(self) -> float:
        """Convergence threshold of the appearance loss."""
        reduced = self._channels < self.encoder.channels
        return self.settings.tau or (TAU if reduced else self.encoder.tau)

    @property
    def _channels(self) -> int:
        return feature_channels(self.encoder, self.config.object.texture_channels)

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[PaperState, FrameEstimate]:
        """Fit prototype, shape and texture to the first frame.

        Raises:
            InputError: If the first frame's mask is missing or empty, or the prototype cannot be used.
        """
        binary = first_mask(frame, mask)
        ellipse = mask_ellipse(binary)
        translation = torch.tensor(first_translation(ellipse, self.camera), dtype=torch.float32)
        pose = Pose.identity(translation.to(self.device))
        prototype = prototype_mesh(self.config.object, ellipse)
        shape = Shape.of(prototype, self.config.object.flat, self.device)
        size = self.config.object.texture_size
        offsets = torch.zeros_like(shape.rest)
        if shape.flat:
            # Facing the camera: any plane fits a ball, and the one that fits an ellipsoid best is seen edge-on.
            offsets[:, 2] = -shape.rest[:, 2]
        belief = PaperState(
            self.camera,
            shape,
            TexelMap.of(shape.face_uvs, size),
            offsets,
            torch.zeros(self._channels, size, size, device=self.device),
            (),
            BackProjection(
                torch.zeros(3, size, size, device=self.device), torch.zeros(size, size, device=self.device)
            ),
            (pose, frame.index),
            waiting=() if self.settings.start_frames > 1 else None,
            renderer=self.config.runtime.renderer,
        )
        observation = self._observe(belief, frame, binary, pose)
        if self._channels < self.encoder.channels:
            space = FeatureSpace.of(observation.features, observation.mask, self._channels)
            belief = replace(belief, space=space)
            observation = replace(observation, features=space.project(observation.features))
        return self._solve(belief, frame, binary, PosedObservation(observation, pose))

    def step(self, state: PaperState, frame: Frame, mask: MaskEstimate) -> tuple[PaperState, FrameEstimate]:
        """Track one more frame."""
        binary = mask.binary
        if binary is not None and not binary.any():
            binary = None
        candidates = [state.last[0]]
        if self.settings.prediction == "velocity":
            candidates = candidate_poses(state, frame.index, binary)
        observation = self._observe(state, frame, binary, candidates[0])
        pose = self._best_candidate(state, observation, candidates)
        return self._solve(state, frame, binary, PosedObservation(observation, pose))

    def result(self, state: PaperState) -> ObjectModel:
        """The object with its visible texture back-projected from the keyframes (section 3.4)."""
        texture, weight = visible_texture(state.seen_with_keyframes())
        return ObjectModel(
            state.vertices.double().cpu().numpy(),
            state.shape.faces.cpu().numpy(),
            state.shape.face_uvs.double().cpu().numpy(),
            texture,
            weight,
            state.texture.permute(1, 2, 0).cpu().numpy(),
        )

    def _observe(
        self, belief: PaperState, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        return self.observe(frame, mask, pose, belief.vertices, belief.camera, belief.space)

    def _best_candidate(self, belief: PaperState, observation: Observation, candidates: list[Pose]) -> Pose:
        """The pose with the least loss as it stands."""
        if len(candidates) == 1:
            return candidates[0]
        problem = self._problem_of_pose(belief, observation)
        totals = []
        for pose in candidates:
            with torch.no_grad():
                losses = problem.losses(belief.parameters([PosedObservation(observation, pose)]))
            totals.append(float(losses.total(self.settings.weights)))
        return candidates[int(np.argmin(np.nan_to_num(totals, nan=np.inf)))]

    def _problem_of_pose(self, belief: PaperState, observation: Observation) -> Problem:
        """One frame against the shape and texture known so far."""
        seen = previous = None
        if self.settings.unseen_charge is not None:
            seen = (belief.seen_with_keyframes().weight > 0).float()[None]
        if belief.keyframes:
            keyframe = belief.keyframes[-1]
            previous = keyframe.pose, keyframe.observation.index
        return Problem(
            belief.shape, ObservationBatch.of([observation]), self.settings, seen, previous, belief.renderer
        )

    def _solve(
        self, belief: PaperState, frame: Frame, mask: NDArray[np.bool_] | None, current: PosedObservation
    ) -> tuple[PaperState, FrameEstimate]:
        """Optimize, judge, choose keyframes, answer."""
        first, iterations = not belief.started, 0
        optimum = None
        if self.settings.pose_iterations and not first:
            optimum = self._refine_pose(belief, current)
            iterations = optimum.iterations
            if not optimum.reason:
                current = PosedObservation(current.observation, optimum.parameters.poses[0])
        frames = [current]
        if optimum is None or self._needs_joint(belief, current, optimum):
            with in_stage("map"):
                frames, optimum = self._optimize(self._with_new_texture(belief, current), current)
            iterations += optimum.iterations
        losses = optimum.losses.of_frame(-1)
        answer = FrameEstimate(
            index=frame.index,
            time=frame.time,
            T_cam_obj=optimum.parameters.poses[-1].matrix().numpy(),
            mask=mask if mask is not None else np.zeros(frame.size, dtype=np.bool_),
            initial_mask=mask,
            status=Status.LOST,
            reason="",
            confidence=0.0,
            losses=losses,
            iterations=iterations,
            mask_source=MaskSource.handed_back(mask),
        )
        judgement = self._judge(optimum, -1, mask is not None)
        if judgement.status is Status.LOST and (optimum.reason or not first):
            # What was known before stays; only the pose goes on from where the optimization left it.
            if not optimum.reason:
                belief = replace(belief, last=(optimum.parameters.poses[-1], frame.index), before=None)
            return replace(belief, started=True), self._answered(answer, judgement)
        joint = len(frames) > 1 or first or not belief.keyframes
        if joint:
            with in_stage("map"):
                known = self._updated(belief, frames, optimum)
        else:
            known = belief.moved(frames[-1].pose, frame.index)
        if judgement.status is not Status.LOST:
            rendered, source, judgement = self._supported(known.silhouette(known.last[0]), mask, judgement)
            answer = replace(answer, mask=rendered, mask_source=source)
        answer = replace(answer, keyframe=any(k.observation.index == frame.index for k in known.keyframes))
        return self._with_waiting(belief, known, frames, optimum, self._answered(answer, judgement))

    def _supported(
        self, rendered: NDArray[np.bool_], initial: NDArray[np.bool_] | None, judgement: Assessment
    ) -> tuple[NDArray[np.bool_], MaskSource, Assessment]:
        """The rendered mask, or the initial one where the two differ too much (`solver.agreement`)."""
        if initial is None:
            return rendered, MaskSource.RENDERED, judgement
        iou = float(np.sum(rendered & initial)) / max(float(np.sum(rendered | initial)), 1.0)
        if iou >= self.settings.agreement:
            return rendered, MaskSource.RENDERED, judgement
        reason = f"the rendered mask overlaps the initial one by an IoU of {iou:.2f} only, so that one is the answer"
        return initial, MaskSource.INITIAL, replace(judgement, status=Status.UNCERTAIN, reason=reason)

    def _refine_pose(self, belief: PaperState, current: PosedObservation) -> Optimum:
        """The new frame's pose alone, against what is known."""
        return optimize(
            self._problem_of_pose(belief, current.observation),
            belief.parameters([current]),
            iterations=self.settings.pose_iterations,
            tau=self.tau,
            free="pose",
        )

    def _needs_joint(self, belief: PaperState, current: PosedObservation, optimum: Optimum) -> bool:
        """Whether shape and texture have something to learn from this frame."""
        if self.settings.joint == "always" or belief.waiting is not None or not belief.keyframes:
            return True
        if self._judge(optimum, -1, current.observation.has_mask).status is Status.LOST:
            return True
        latest = belief.keyframes[-1].pose
        return is_new_view(latest, current.pose, belief.object_size, self.settings.keyframes)

    def _with_new_texture(self, belief: PaperState, current: PosedObservation) -> PaperState:
        """Start texels that no keyframe has seen at what the new frame shows."""
        if self.settings.texture_start == "zero":
            return belief
        shown = belief.back_project(current.observation.features, current)
        new = (belief.seen_with_keyframes().weight <= 0) & (shown.weight > 0)
        return replace(belief, texture=torch.where(new, shown.mean(), belief.texture))

    def _optimize(
        self, belief: PaperState, current: PosedObservation
    ) -> tuple[list[PosedObservation], Optimum]:
        """Everything over the keyframes and the new frame; over all first frames when the joint start is due."""
        config = self.settings
        waiting = belief.waiting or ()
        if waiting and len(waiting) + 1 == config.start_frames:
            frames = [keyframe for keyframe, _ in waiting] + [current]
            return frames, joint_start(belief, frames, config, self.tau)
        frames = [*belief.keyframes, current]
        # The gauge: the oldest frame does not move, so that poses stored at different times compare.
        fixed = 1 if belief.keyframes or not belief.started else 0
        batch = ObservationBatch.of([frame.observation for frame in frames])
        problem = Problem(belief.shape, batch, config, backend=belief.renderer)
        start = belief.parameters(frames)
        return frames, optimize(problem, start, iterations=config.iterations, tau=self.tau, fixed=fixed)

    def _judge(self, optimum: Optimum, position: int, has_mask: bool) -> Assessment:
        losses = optimum.losses.of_frame(position)
        silhouette = losses["silhouette"] + losses["distance"]
        limit = self.settings.keyframes.silhouette
        if self.settings.stop == "threshold":
            # The paper's failure is that its stopping rule was not reached, by all frames together.
            losses["features"] = float(optimum.losses.features.mean())
        return assess(losses["features"], silhouette, has_mask, self.tau, limit, optimum.reason)

    def _updated(self, belief: PaperState, frames: list[PosedObservation], optimum: Optimum) -> PaperState:
        """Take over what was found, and choose the keyframes anew."""
        parameters = optimum.parameters
        moved = [PosedObservation(frame.observation, parameters.poses[i]) for i, frame in enumerate(frames)]
        found = replace(belief, offsets=parameters.offsets, texture=parameters.texture)
        silhouette = (optimum.losses.silhouette + optimum.losses.distance).tolist()
        appearance = optimum.losses.features.tolist()
        candidates = [
            KeyframeCandidate(keyframe.pose, silhouette[i], appearance[i]) for i, keyframe in enumerate(moved)
        ]
        criteria = self.settings.keyframes
        kept = select_keyframes(candidates, found.object_size, self.tau, criteria)
        seen = belief.seen
        for i, keyframe in enumerate(moved[:-1]):
            if i not in kept and appearance[i] < self.tau:
                seen = seen + found.back_project(keyframe.observation.image, keyframe)
        found = found.moved(moved[-1].pose, moved[-1].observation.index)
        return replace(found, keyframes=tuple(moved[i] for i in kept), seen=seen)

    def _with_waiting(
        self,
        belief: PaperState,
        known: PaperState,
        frames: list[PosedObservation],
        optimum: Optimum,
        answer: FrameEstimate,
    ) -> tuple[PaperState, FrameEstimate]:
        """Keep the first frames until they are solved together, then answer them anew."""
        if belief.waiting is None:
            return known, answer
        count = len(belief.waiting) + 1
        if count < self.settings.start_frames:
            waiting = (*belief.waiting, (PosedObservation(frames[-1].observation, known.last[0]), answer))
            if answer.status is Status.TRACKED and len(waiting) > 1:
                reason = "the first frames are not yet solved together"
                answer = replace(
                    answer, status=Status.UNCERTAIN, reason=reason, confidence=answer.confidence / 2
                )
            return replace(known, waiting=waiting), answer
        revised = []
        for position, (keyframe, earlier) in enumerate(belief.waiting):
            judgement = self._judge(optimum, position, keyframe.observation.has_mask)
            pose = optimum.parameters.poses[position]
            answered, source = earlier.mask, earlier.mask_source
            if judgement.status is not Status.LOST:
                rendered = known.silhouette(pose)
                answered, source, judgement = self._supported(rendered, earlier.initial_mask, judgement)
            revised.append(
                replace(
                    earlier,
                    T_cam_obj=pose.matrix().numpy(),
                    mask=answered,
                    mask_source=source,
                    status=judgement.status,
                    reason=judgement.reason,
                    confidence=judgement.confidence,
                    losses=optimum.losses.of_frame(position),
                )
            )
        # The motion so far was found before; that of the joint solution is what goes on.
        before = optimum.parameters.poses[-2], frames[-2].observation.index
        return replace(known, before=before, waiting=None), replace(answer, revised=tuple(revised))

    @staticmethod
    def _answered(answer: FrameEstimate, judgement: Assessment) -> FrameEstimate:
        return replace(
            answer,
            status=judgement.status,
            reason=judgement.reason,
            confidence=judgement.confidence,
        )
