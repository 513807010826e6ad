"""The solver of Rozumnyi et al., ICCV 2023, sections 3.1 to 3.4, and what the presets add to it.

In every frame one Adam optimizes the poses of the keyframes and of the new frame, the shape and the texture.
The gauge is fixed: the oldest frame in the window does not move. Where a config key is not the paper's, its
default is, so that preset ``paper`` is the pure recipe.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tracking3d.config.models import KeyframeConfig, PaperConfig, PipelineConfig
from tracking3d.estimation.estimate import Assessment, FrameEstimate, MaskSource, ObjectModel, Status, assess
from tracking3d.estimation.feature_space import TAU, FeatureSpace, feature_channels
from tracking3d.estimation.observation import Observation, ObservationBatch, Observer, downsample
from tracking3d.estimation.paper.problem import Optimum, Parameters, Problem, optimize
from tracking3d.estimation.shape import (
    Shape,
    first_mask,
    first_translation,
    mask_ellipse,
    prototype_mesh,
    visible_texture,
)
from tracking3d.estimation.solver import STATE_CLASSES
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate, mask_iou_or_none
from tracking3d.geometry.camera import NEAR, Camera
from tracking3d.geometry.pose import Pose, extrapolate, from_matrix, rotation_angle, rotation_exponential
from tracking3d.rendering import BackProjection, TexelMap, back_project, project, rasterize
from tracking3d.runtime.stage_times import in_stage


@dataclass(frozen=True, eq=False)
class PosedObservation:
    """A frame that stays in the optimization, with its pose as it stands."""

    observation: Observation
    pose: Pose


@dataclass(frozen=True, eq=False)
class PaperState:
    """What the solver knows."""

    camera: Camera  # the camera of the video
    shape: Shape  # the fixed part of the object
    texels: TexelMap  # where each texel lies on the surface
    offsets: Tensor  # (V, 3) vertex offsets from the prototype
    texture: Tensor  # (C, T, T) feature texture
    keyframes: tuple[PosedObservation, ...]  # in order of time
    seen: BackProjection  # RGB that former keyframes showed of each texel
    last: tuple[Pose, int]  # pose and index of the last frame, a lost one's included
    # the same of the frame before that one; None if there is no motion to go on with
    before: tuple[Pose, int] | None = None
    # first frames that wait for the joint start, with their answers so far; None when none waits any more
    waiting: tuple[tuple[PosedObservation, FrameEstimate], ...] | None = None
    started: bool = False  # whether the first frame is done
    space: FeatureSpace | None = None  # what is made of the encoder's features; None leaves them as they are
    renderer: str = "auto"  # which renderer, see `tracking3d.rendering.backend`

    @property
    def vertices(self) -> Tensor:
        """``(V, 3)`` in object coordinates."""
        return self.shape.rest + self.offsets

    @property
    def object_size(self) -> float:
        """Diameter of the object in object units."""
        centred = self.vertices - self.vertices.mean(0)
        return 2 * float(centred.norm(dim=1).max())

    def moved(self, pose: Pose, index: int) -> PaperState:
        """The same state one frame later."""
        return replace(self, last=(pose, index), before=self.last if self.started else None, started=True)

    def back_project(self, values: Tensor, keyframe: PosedObservation) -> BackProjection:
        """What a frame shows of the texture; ``values`` is ``(C, H, W)`` over the frame's window."""
        observation = keyframe.observation
        scale = values.shape[-1] / observation.window.size
        K = observation.K.clone()
        K[:2] *= scale
        K[:2, 2] += (scale - 1) / 2  # pixel centres stay at integers
        valid = observation.valid * (observation.mask if observation.has_mask else 1.0)
        valid = torch.nn.functional.interpolate(valid[None, None], size=values.shape[-2:], mode="bilinear")[
            0, 0
        ]
        return back_project(
            values, valid, self.vertices, self.shape.faces, self.texels, keyframe.pose.R,
            keyframe.pose.translation, K, self.renderer,
        )  # fmt: skip

    def visible_texture_of_keyframes(self) -> BackProjection:
        """RGB seen of each texel, the present keyframes included."""
        seen = self.seen
        for keyframe in self.keyframes:
            seen = seen + self.back_project(keyframe.observation.image, keyframe)
        return seen

    def silhouette(self, pose: Pose) -> NDArray[np.bool_]:
        """Hard silhouette ``(H, W)`` in the full frame."""
        size = (self.camera.height, self.camera.width)
        K = torch.tensor(self.camera.K, dtype=torch.float32, device=self.offsets.device)
        screen, depth = project(self.vertices, pose.R[None], pose.translation[None], K[None])
        covered = rasterize(screen, depth, self.shape.faces, size, self.renderer).face_index[0] >= 0
        return np.asarray(covered.cpu().numpy(), dtype=np.bool_)

    def parameters(self, frames: list[PosedObservation]) -> Parameters:
        """Poses of the frames, with the shape and texture as they are."""
        poses = Pose.stack([frame.pose for frame in frames])
        return Parameters(poses.translation, poses.quaternion, self.offsets, self.texture)


@dataclass(frozen=True)
class PaperSolver:
    """See the module; implements `tracking3d.estimation.solver.Solver`."""

    config: PipelineConfig  # the pipeline's configuration
    camera: Camera  # the camera of the full frame
    encoder: FeatureEncoder  # the feature encoder

    state_classes: ClassVar[tuple[type, ...]] = (*STATE_CLASSES, PaperState, PosedObservation)
    """What a `PaperState` is made of, for keeping it."""

    @property
    def _observer(self) -> Observer:
        return Observer(self.config, self.camera, self.encoder)

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
        pose = Pose.identity(translation.to(self._observer.device))
        prototype = prototype_mesh(self.config.object, ellipse)
        shape = Shape.of(prototype, self.config.object.flat, self._observer.device)
        size, device = self.config.object.texture_size, self._observer.device
        offsets = torch.zeros_like(shape.rest)
        if shape.flat:
            # Facing the camera: any plane fits a ball, and the one that fits an ellipsoid best is seen edge-on.
            offsets[:, 2] = -shape.rest[:, 2]
        state = PaperState(
            self.camera,
            shape,
            TexelMap.of(shape.face_uvs, size),
            offsets,
            torch.zeros(self._channels, size, size, device=device),
            (),
            BackProjection(
                torch.zeros(3, size, size, device=device),
                torch.zeros(size, size, device=device),
            ),
            (pose, frame.index),
            waiting=() if self.settings.init_frames > 1 else None,
            renderer=self.config.runtime.renderer,
        )
        observation = self._observe(state, frame, binary, pose)
        if self._channels < self.encoder.channels:
            space = FeatureSpace.of(observation.features, observation.mask, self._channels)
            state = replace(state, space=space)
            observation = replace(observation, features=space.project(observation.features))
        return self._solve(state, frame, binary, PosedObservation(observation, pose))

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
        texture, weight = visible_texture(state.visible_texture_of_keyframes())
        return ObjectModel(
            state.vertices.double().cpu().numpy(),
            state.shape.faces.cpu().numpy(),
            state.shape.face_uvs.double().cpu().numpy(),
            texture,
            weight,
            state.texture.permute(1, 2, 0).cpu().numpy(),
        )

    def _observe(
        self, state: PaperState, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        return self._observer.observe(frame, mask, pose, state.vertices, state.camera, state.space)

    def _best_candidate(self, state: PaperState, observation: Observation, candidates: list[Pose]) -> Pose:
        """The pose with the least loss as it stands."""
        if len(candidates) == 1:
            return candidates[0]
        problem = self._problem_of_pose(state, observation)
        totals = []
        for pose in candidates:
            with torch.no_grad():
                losses = problem.losses(state.parameters([PosedObservation(observation, pose)]))
            totals.append(float(losses.total(self.settings.weights)))
        return candidates[int(np.argmin(np.nan_to_num(totals, nan=np.inf)))]

    def _problem_of_pose(self, state: PaperState, observation: Observation) -> Problem:
        """One frame against the shape and texture known so far."""
        seen = previous = None
        if self.settings.unseen_penalty is not None:
            seen = (state.visible_texture_of_keyframes().weight > 0).float()[None]
        if state.keyframes:
            keyframe = state.keyframes[-1]
            previous = keyframe.pose, keyframe.observation.index
        return Problem(
            state.shape, ObservationBatch.of([observation]), self.settings, seen, previous, state.renderer
        )

    def _solve(
        self, state: PaperState, frame: Frame, mask: NDArray[np.bool_] | None, current: PosedObservation
    ) -> tuple[PaperState, FrameEstimate]:
        """Optimize, assess, select keyframes, and return the estimate."""
        first, iterations = not state.started, 0
        optimum = None
        if self.settings.pose_iterations and not first:
            optimum = self._refine_pose(state, current)
            iterations = optimum.iterations
            if not optimum.reason:
                current = PosedObservation(current.observation, optimum.parameters.poses[0])
        frames = [current]
        if optimum is None or self._needs_joint(state, current, optimum):
            with in_stage("map"):
                frames, optimum = self._optimize(self._with_new_texture(state, current), current)
            iterations += optimum.iterations
        losses = optimum.losses.of_frame(-1)
        estimate = FrameEstimate(
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
            mask_source=MaskSource.as_initial(mask),
        )
        assessment = self._judge(optimum, -1, mask is not None)
        if assessment.status is Status.LOST and (optimum.reason or not first):
            # What was known before stays; only the pose goes on from where the optimization left it.
            if not optimum.reason:
                state = replace(state, last=(optimum.parameters.poses[-1], frame.index), before=None)
            return replace(state, started=True), self._answered(estimate, assessment)
        joint = len(frames) > 1 or first or not state.keyframes
        if joint:
            with in_stage("map"):
                known = self._update(state, frames, optimum)
        else:
            known = state.moved(frames[-1].pose, frame.index)
        if assessment.status is not Status.LOST:
            rendered, source, assessment = self._assess_support(
                known.silhouette(known.last[0]), mask, assessment
            )
            estimate = replace(estimate, mask=rendered, mask_source=source)
        estimate = replace(
            estimate, keyframe=any(k.observation.index == frame.index for k in known.keyframes)
        )
        return self._with_waiting(state, known, frames, optimum, self._answered(estimate, assessment))

    def _assess_support(
        self, rendered: NDArray[np.bool_], initial: NDArray[np.bool_] | None, assessment: Assessment
    ) -> tuple[NDArray[np.bool_], MaskSource, Assessment]:
        """The rendered mask, or the initial one where the two differ too much (`solver.min_mask_iou`)."""
        if initial is None:
            return rendered, MaskSource.RENDERED, assessment
        iou = mask_iou_or_none(rendered, initial) or 0.0
        if iou >= self.settings.min_mask_iou:
            return rendered, MaskSource.RENDERED, assessment
        reason = f"the rendered mask overlaps the initial one by an IoU of {iou:.2f} only, so that one is the answer"
        return initial, MaskSource.INITIAL, replace(assessment, status=Status.UNCERTAIN, reason=reason)

    def _refine_pose(self, state: PaperState, current: PosedObservation) -> Optimum:
        """The new frame's pose alone, against what is known."""
        return optimize(
            self._problem_of_pose(state, current.observation),
            state.parameters([current]),
            iterations=self.settings.pose_iterations,
            tau=self.tau,
            free="pose",
        )

    def _needs_joint(self, state: PaperState, current: PosedObservation, optimum: Optimum) -> bool:
        """Whether shape and texture have something to learn from this frame."""
        if self.settings.joint_when == "always" or state.waiting is not None or not state.keyframes:
            return True
        if self._judge(optimum, -1, current.observation.has_mask).status is Status.LOST:
            return True
        latest = state.keyframes[-1].pose
        return is_new_view(latest, current.pose, state.object_size, self.settings.keyframes)

    def _with_new_texture(self, state: PaperState, current: PosedObservation) -> PaperState:
        """Initialize texels that no keyframe has seen with what the new frame shows."""
        if self.settings.texture_init == "zero":
            return state
        shown = state.back_project(current.observation.features, current)
        new = (state.visible_texture_of_keyframes().weight <= 0) & (shown.weight > 0)
        return replace(state, texture=torch.where(new, shown.mean(), state.texture))

    def _optimize(
        self, state: PaperState, current: PosedObservation
    ) -> tuple[list[PosedObservation], Optimum]:
        """Everything over the keyframes and the new frame; over all first frames when the joint start is due."""
        config = self.settings
        waiting = state.waiting or ()
        if waiting and len(waiting) + 1 == config.init_frames:
            frames = [keyframe for keyframe, _ in waiting] + [current]
            return frames, initialize_jointly(state, frames, config, self.tau)
        frames = [*state.keyframes, current]
        # The gauge: the oldest frame does not move, so that poses stored at different times compare.
        fixed = 1 if state.keyframes or not state.started else 0
        batch = ObservationBatch.of([frame.observation for frame in frames])
        problem = Problem(state.shape, batch, config, backend=state.renderer)
        start = state.parameters(frames)
        return frames, optimize(problem, start, iterations=config.iterations, tau=self.tau, fixed=fixed)

    def _judge(self, optimum: Optimum, position: int, has_mask: bool) -> Assessment:
        losses = optimum.losses.of_frame(position)
        silhouette = losses["silhouette"] + losses["distance"]
        limit = self.settings.keyframes.silhouette
        if self.settings.stop == "threshold":
            # The paper's failure is that its stopping rule was not reached, by all frames together.
            losses["appearance"] = float(optimum.losses.features.mean())
        return assess(losses["appearance"], silhouette, has_mask, self.tau, limit, optimum.reason)

    def _update(self, state: PaperState, frames: list[PosedObservation], optimum: Optimum) -> PaperState:
        """Take over the result, and select the keyframes again."""
        parameters = optimum.parameters
        moved = [PosedObservation(frame.observation, parameters.poses[i]) for i, frame in enumerate(frames)]
        found = replace(state, offsets=parameters.offsets, texture=parameters.texture)
        silhouette = (optimum.losses.silhouette + optimum.losses.distance).tolist()
        appearance = optimum.losses.features.tolist()
        candidates = [
            KeyframeCandidate(keyframe.pose, silhouette[i], appearance[i]) for i, keyframe in enumerate(moved)
        ]
        criteria = self.settings.keyframes
        kept = select_keyframes(candidates, found.object_size, self.tau, criteria)
        seen = state.seen
        for i, keyframe in enumerate(moved[:-1]):
            if i not in kept and appearance[i] < self.tau:
                seen = seen + found.back_project(keyframe.observation.image, keyframe)
        found = found.moved(moved[-1].pose, moved[-1].observation.index)
        return replace(found, keyframes=tuple(moved[i] for i in kept), seen=seen)

    def _with_waiting(
        self,
        state: PaperState,
        known: PaperState,
        frames: list[PosedObservation],
        optimum: Optimum,
        estimate: FrameEstimate,
    ) -> tuple[PaperState, FrameEstimate]:
        """Keep the first frames until they are solved together, then estimate them again."""
        if state.waiting is None:
            return known, estimate
        count = len(state.waiting) + 1
        if count < self.settings.init_frames:
            waiting = (*state.waiting, (PosedObservation(frames[-1].observation, known.last[0]), estimate))
            if estimate.status is Status.TRACKED and len(waiting) > 1:
                reason = "the first frames are not yet solved together"
                estimate = replace(
                    estimate, status=Status.UNCERTAIN, reason=reason, confidence=estimate.confidence / 2
                )
            return replace(known, waiting=waiting), estimate
        revised = []
        for position, (keyframe, earlier) in enumerate(state.waiting):
            assessment = self._judge(optimum, position, keyframe.observation.has_mask)
            pose = optimum.parameters.poses[position]
            answered, source = earlier.mask, earlier.mask_source
            if assessment.status is not Status.LOST:
                rendered = known.silhouette(pose)
                answered, source, assessment = self._assess_support(
                    rendered, earlier.initial_mask, assessment
                )
            revised.append(
                replace(
                    earlier,
                    T_cam_obj=pose.matrix().numpy(),
                    mask=answered,
                    mask_source=source,
                    status=assessment.status,
                    reason=assessment.reason,
                    confidence=assessment.confidence,
                    losses=optimum.losses.of_frame(position),
                )
            )
        # The motion so far was found before; that of the joint solution is what goes on.
        before = optimum.parameters.poses[-2], frames[-2].observation.index
        return replace(known, before=before, waiting=None), replace(estimate, revised=tuple(revised))

    @staticmethod
    def _answered(estimate: FrameEstimate, assessment: Assessment) -> FrameEstimate:
        return replace(
            estimate,
            status=assessment.status,
            reason=assessment.reason,
            confidence=assessment.confidence,
        )


# An initialization from the first few frames together, by several hypotheses of how the object rotates.
#
# Frame by frame against a wrong first shape the estimate locks into depth reversal or too little rotation while
# its silhouette still fits. The hypothesis that re-renders all first frames best wins.

RATES = (3.0, 8.0)
"""Degrees a frame that the hypotheses turn."""
DIRECTIONS = 8
_SEMIFINALISTS = 6
_FINALISTS = 2


def initialize_jointly(
    state: PaperState, frames: list[PosedObservation], config: PaperConfig, tau: float
) -> Optimum:
    """Solve shape, texture and all poses of ``frames``; the first pose is fixed.

    Args:
        state: The initial shape and texture of every hypothesis.
        frames: The first frames, with the poses found one by one: one of the hypotheses.
        config: The solver's constants; ``stop`` is taken as ``plateau``.
        tau: The encoder's convergence threshold.
    """
    config = config.model_copy(update={"stop": "plateau", "patience": config.init_iterations})
    coarse, fine = (
        Problem(state.shape, ObservationBatch.of(observations), config, backend=state.renderer)
        for observations in (
            [downsample(frame.observation) for frame in frames],
            [frame.observation for frame in frames],
        )
    )
    spent = 0
    optima: list[Optimum] = []
    starts = [state.parameters(frames), *hypotheses(state, frames)]
    for problem, survivors, share in (
        (coarse, len(starts), 3),
        (coarse, _SEMIFINALISTS, 1),
        (fine, _FINALISTS, 1),
    ):
        starts = starts[:survivors]
        iterations = max(config.init_iterations // share, 1)
        optima = [optimize(problem, start, iterations=iterations, tau=tau, fixed=1) for start in starts]
        spent += sum(optimum.iterations for optimum in optima)
        optima.sort(key=lambda optimum: math.inf if optimum.reason else optimum.total)
        starts = [optimum.parameters for optimum in optima]
    return replace(optima[0], iterations=spent)


def hypotheses(state: PaperState, frames: list[PosedObservation]) -> list[Parameters]:
    """No rotation; the rotations found so far mirrored in depth; turning in eight directions at two rates.

    Translations are those found so far: they are seen directly.
    """
    first, found = frames[0].pose, Pose.stack([frame.pose for frame in frames])
    elapsed = [frame.observation.index - frames[0].observation.index for frame in frames]
    still = Pose(found.translation, first.quaternion.expand_as(found.quaternion))
    variants = [still, _mirror(first, found)]
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = first.translation.new_tensor([math.cos(angle), math.sin(angle), 0.0])
        variants += [_rotate(first, found, axis, rate, elapsed) for rate in RATES]
    return [
        Parameters(poses.translation, poses.quaternion, state.offsets, state.texture) for poses in variants
    ]


def _rotate(first: Pose, found: Pose, axis: Tensor, rate: float, elapsed: list[int]) -> Pose:
    """The first rotation turned about ``axis`` by ``rate`` degrees in each of the elapsed frames, by 60 at most."""
    angles = axis.new_tensor([math.radians(max(min(rate * frames, 60.0), -60.0)) for frames in elapsed])
    turn = rotation_exponential(angles[:, None] * functional.normalize(axis, dim=0))
    return from_matrix(turn @ first.R, found.translation)


def _mirror(first: Pose, found: Pose) -> Pose:
    """The rotations since the first frame with their tilt out of the image plane reversed (Necker)."""
    delta = found.R @ first.R.T
    flip = torch.diag(delta.new_tensor([1.0, 1.0, -1.0]))
    return from_matrix(flip @ delta @ flip @ first.R, found.translation)


# Which frames stay in the optimization (paper section 3.4, "Keyframe selection criteria").
#
# All criteria are judged again after every joint optimization (in preset ``paper`` that is every frame), so a
# keyframe can fall out.


@dataclass(frozen=True, eq=False)
class KeyframeCandidate:
    """A keyframe, or the current frame, as it stands after the optimization."""

    pose: Pose  # its pose now
    silhouette_loss: float  # L_S of this frame alone
    appearance_loss: float  # L_F of this frame alone


def select_keyframes(
    candidates: Sequence[KeyframeCandidate], object_size: float, tau: float, config: KeyframeConfig
) -> list[int]:
    """Positions of the candidates that are keyframes from now on.

    Args:
        candidates: The keyframes so far in order of time, then the current frame.
        object_size: Diameter of the object in object units.
        tau: Convergence threshold of the appearance loss.
        config: The criteria.
    """
    limit = config.features or tau
    kept: list[int] = []
    for position, candidate in enumerate(candidates):
        anchor = config.keep_first and position == 0
        consistent = candidate.silhouette_loss < config.silhouette and candidate.appearance_loss < limit
        latest = candidates[kept[-1]].pose if kept else None
        if anchor or (
            consistent and (latest is None or is_new_view(latest, candidate.pose, object_size, config))
        ):
            kept.append(position)
    if config.keep_first and len(kept) > config.maximum:
        return thin_out(kept, config.maximum)
    return kept[-config.maximum :]


def is_new_view(latest: Pose, pose: Pose, object_size: float, config: KeyframeConfig) -> bool:
    """Whether the object moved or turned enough since the latest keyframe."""
    moved = float(torch.linalg.vector_norm(pose.translation - latest.translation))
    turned = math.degrees(float(rotation_angle(latest.quaternion, pose.quaternion)))
    return moved > config.translation * object_size or turned > config.rotation


def thin_out(kept: list[int], maximum: int) -> list[int]:
    """Half the most recent, half spread evenly over the older ones; the first always stays."""
    recent = kept[len(kept) - maximum // 2 :]
    older = kept[: len(kept) - maximum // 2]
    count = maximum - len(recent)
    chosen = [older[round(i * (len(older) - 1) / max(count - 1, 1))] for i in range(count)]
    return sorted(set(chosen) | set(recent))


def candidate_poses(state: PaperState, index: int, mask: NDArray[np.bool_] | None) -> list[Pose]:
    """The last pose, constant velocity, and their rotations moved to the mask.

    After a lost frame there is no velocity to go on with; the keyframes' poses are tried instead.
    """
    last, last_index = state.last
    candidates = [last]
    if state.before is not None:
        before, before_index = state.before
        steps = (index - last_index) / max(last_index - before_index, 1)
        candidates.append(extrapolate(before, last, min(steps, 3.0)))
    else:
        candidates += [keyframe.pose for keyframe in state.keyframes]
    if mask is not None and mask.any():
        candidates += [shift_to_mask(state, pose, mask) for pose in list(candidates)]
    return candidates


def shift_to_mask(state: PaperState, pose: Pose, mask: NDArray[np.bool_]) -> Pose:
    """Shift a pose so that its silhouette has the mask's centroid and area."""
    silhouette = state.silhouette(pose)
    camera = state.camera
    x1, y1 = _centroid(mask)
    if silhouette.any():
        x0, y0 = _centroid(silhouette)
        ratio = float(np.clip(np.sqrt(silhouette.sum() / mask.sum()), 0.8, 1.25))
    else:  # the pose has left the view: bring its centre back
        x, y, z = pose.translation.tolist()
        x0, y0 = camera.cx + camera.fx * x / max(z, NEAR), camera.cy + camera.fy * y / max(z, NEAR)
        ratio = 1.0
    depth = float(pose.translation[2])
    shift = pose.translation.new_tensor([(x1 - x0) / camera.fx * depth, (y1 - y0) / camera.fy * depth, 0.0])
    return Pose((pose.translation + shift) * ratio, pose.quaternion)


def _centroid(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.argwhere(mask)[:, ::-1].mean(0)
