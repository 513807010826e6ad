"""One object tracked through one video: the parts that a configuration names, and the state between frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.arguments import check_frame, check_session
from tracking3d.config.camera import choose_camera, warn_of_unlikely
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.estimation.correction import corrects
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status, unanswered
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.paper.solver import PaperSolver
from tracking3d.estimation.solver import RefiningSolver, Solver
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate, Prompt, pixels
from tracking3d.geometry.camera import Camera
from tracking3d.plugins import FEATURES, TRACKERS, build_plugin, plugin_label
from tracking3d.plugins.guard import GuardedEncoder, GuardedTracker, PluginFailure
from tracking3d.process_settings import OwnSettings, RandomState, process_kept
from tracking3d.prompts import check_prompt_fits
from tracking3d.rendering.backend import choose_backend, threads_kept
from tracking3d.stages import StageTimes, Stopwatch, measured

SOLVERS: dict[str, Callable[[PipelineConfig, Camera, FeatureEncoder], Solver[Any]]] = {
    "paper": PaperSolver,
    "online": OnlineSolver,
}
"""Solvers by the name that `solver.name` selects."""

_CPU = argument("runtime.device 'cpu'", "--device cpu")


class Session:
    """One object tracked through one video: ``step`` takes each frame, ``result`` gives the object.

    The process's threads and random numbers are the session's only while it works; in between they are the caller's.

    Args:
        config: The pipeline.
        prompt: The object in the first frame; None takes the mask tracker's own first mask.
        intrinsics: fx, fy, cx, cy that the source knows of, in pixels; the configuration wins over them.
        intrinsics_origin: Where they come from, in words.
        encoder: A feature encoder that several sessions share, see `build_encoder`; one of its own if None.

    Attributes:
        config: The pipeline.
        renderer: What renders, and why, see `tracking3d.rendering.backend.choose_backend`.
        initial_mask: What the solver was given for the latest frame: the mask tracker's answer, or what stands in.
        corrected: Whether the latest answer was handed back to the mask tracker.
        refining: What ``refine`` took.

    Raises:
        PluginError: If a plug-in is unknown or broken.
        InputError: If an argument is of the wrong kind, or an option cannot be used on this machine.
    """

    def __init__(
        self,
        config: PipelineConfig,
        prompt: Prompt | None,
        intrinsics: tuple[float, float, float, float] | None = None,
        intrinsics_origin: str = "",
        encoder: FeatureEncoder | None = None,
    ) -> None:
        check_session(config, prompt, intrinsics)
        check_device(config.runtime.device)
        if prompt is None and config.tracker.name != "precomputed":
            raise InputError("Say what the object is by either a box or a mask of the first frame.")
        runtime = config.runtime
        try:
            self.renderer = choose_backend(runtime.renderer, runtime.device, runtime.threads)
        except ValueError as error:
            raise InputError(f"runtime.renderer: {error}.") from error
        self.config = config
        self._prompt = prompt
        self._intrinsics = intrinsics, intrinsics_origin
        self._settings = OwnSettings(self.renderer, runtime.device, runtime.seed)
        self._replaying = OwnSettings(self.renderer, runtime.device, runtime.seed)
        with self._settings.in_force():
            self._tracker = GuardedTracker(
                build_plugin(TRACKERS, config.tracker), plugin_label(TRACKERS, config.tracker.name)
            )
            self._encoder = build_encoder(config) if encoder is None else encoder
        self._solver: Solver[Any] | None = None
        self._state: Any = None
        self._camera: Camera | None = None
        self.initial_mask = MaskEstimate(None)
        self.corrected = False
        self._last_pose = np.eye(4)
        self._failures: dict[int, str] = {}
        self._refined = False
        self.refining = StageTimes()

    @property
    def camera(self) -> Camera:
        """The camera of the full frame, known from the first frame on."""
        if self._camera is None:
            raise RuntimeError("the camera is known after the first step")
        return self._camera

    def step(self, frame: Frame) -> FrameEstimate:
        """Track the object in the next frame; the first call starts on it.

        Raises:
            InputError: If this is no `Frame` of uint8 RGB, the first one has no object, or another size than the first.
            PluginError: If a plug-in fails: in the first frame, or with ``runtime.on_plugin_failure`` ``stop`` in
                any. With ``continue`` a later frame is answered with what there is, and ``failure`` says why.
            RuntimeError: After ``refine``.
        """
        if self._refined:
            raise RuntimeError("there is no further step after refine")
        check_frame(frame)
        try:
            with self._settings.in_force(), measured("solve") as watch:
                estimate = self._start(frame) if self._solver is None else self._go_on(self._solver, frame)
        except PluginFailure as error:
            raise error.at(_label(frame)) from error.__cause__
        return _timed(estimate, watch, frame)

    def _start(self, frame: Frame) -> FrameEstimate:
        solver = self._begun(frame)
        if self._prompt is not None:
            check_prompt_fits(self._prompt, frame)
        mask = self._tracker.init(frame, self._prompt_for(frame))
        self._state, estimate = solver.init(frame, mask)
        self._solver, self.initial_mask, self._last_pose = solver, mask, estimate.T_cam_obj
        return estimate

    def _begun(self, first: Frame) -> Solver[Any]:
        """The solver for a video that begins with ``first``; the camera is set for it, too."""
        height, width = first.size
        self._camera = choose_camera(self.config.camera, width, height, *self._intrinsics)
        warn_of_unlikely(self._camera)
        return SOLVERS[self.config.solver.name](self.config, self._camera, self._encoder)

    def _prompt_for(self, first: Frame) -> Prompt:
        height, width = first.size
        return self._prompt or Prompt((0.0, 0.0, float(width), float(height)))

    @property
    def state_classes(self) -> tuple[type, ...]:
        """The classes of what `kept` gives, beside arrays, tensors and plain values."""
        own: tuple[type, ...] = getattr(SOLVERS[self.config.solver.name], "state_classes", ())
        return (Camera, MaskEstimate, RandomState, StageTimes, *own)

    def kept(self) -> dict[str, Any]:
        """All that another session needs to go on after the latest frame, see `resume`; its parts never change."""
        return {
            "solver": self._state,
            "camera": self._camera,
            "initial_mask": self.initial_mask,
            "last_pose": self._last_pose,
            "refined": self._refined,
            "refining": self.refining,
            "random": self._settings.random,
            "tracker": self._tracker.state() if self._tracker.can_resume else None,
        }

    def resume(self, first: Frame, kept: Mapping[str, Any], failures: Mapping[int, str]) -> None:
        """Be the session that was `kept`, instead of starting on a first frame.

        Where `replays`, the frames up to the one after which it was kept are to come to `replay` before the next
        ``step``.

        Args:
            first: The first frame.
            kept: What `kept` gave.
            failures: Which plug-ins failed in which frames.

        Raises:
            PluginError: If the mask tracker cannot go on.
        """
        self._solver = self._begun(first)
        self._state, self._camera = kept["solver"], kept["camera"]
        self.initial_mask, self._last_pose = kept["initial_mask"], kept["last_pose"]
        self._refined, self._failures = kept["refined"], dict(failures)
        self.refining, self._settings.random = kept["refining"], kept["random"]
        if self._tracker.can_resume and not self._refined:
            with self._settings.in_force():
                self._tracker.restore(first, self._prompt_for(first), kept["tracker"])

    @property
    def replays(self) -> bool:
        """Whether the mask tracker has to see the frames again after `resume`."""
        return not self._tracker.can_resume and not self._refined

    def replay(self, frame: Frame, first: bool, correction: NDArray[np.bool_] | None) -> MaskEstimate | None:
        """Take the mask tracker alone through a frame that is answered already.

        Args:
            frame: The frame.
            first: Whether it is the first one.
            correction: ``(H, W)`` what was handed back to the tracker after it, if anything was.

        Returns:
            The tracker's answer; None where it fails.
        """
        answer = None
        try:
            with self._replaying.in_force():
                answer = (
                    self._tracker.init(frame, self._prompt_for(frame)) if first else self._tracker.step(frame)
                )
                if correction is not None:
                    self._tracker.correct(frame, correction)
        except PluginFailure as error:
            if first:
                raise error.at(_label(frame)) from error.__cause__
        return answer

    def _go_on(self, solver: Solver[Any], frame: Frame) -> FrameEstimate:
        if frame.size != (self.camera.height, self.camera.width):
            raise InputError(
                f"{_label(frame)} has {pixels(frame.size)} pixels but the first frame "
                f"{pixels((self.camera.height, self.camera.width))}; all frames must have one size."
            )
        failures = []
        self.corrected = False
        try:
            mask = self._tracker.step(frame)
        except PluginFailure as error:
            failures.append(self._excused(error))
            mask = replace(self.initial_mask, score=0.0, reason=error.reason)
        self.initial_mask = mask
        try:
            self._state, estimate = solver.step(self._state, frame, mask)
        except PluginFailure as error:
            failures.append(self._excused(error))
            estimate = unanswered(frame, mask, self._last_pose)
        self._last_pose, self._camera = estimate.T_cam_obj, estimate.camera or self._camera
        if self.config.solver.correct_tracker and self._tracker.can_correct and corrects(estimate):
            self.corrected = True
            try:
                self._tracker.correct(frame, estimate.mask)
            except PluginFailure as error:
                failures.append(self._excused(error))
        if failures:
            self._failures[frame.index] = "; ".join(failures)
        revised = tuple(self._with_failure(earlier) for earlier in estimate.revised)
        return self._with_failure(replace(estimate, revised=revised))

    def _excused(self, error: PluginFailure) -> str:
        """Why a plug-in failed, where the run goes on in spite of it."""
        if self.config.runtime.on_plugin_failure == "stop":
            raise error
        return error.reason

    def failure_at(self, index: int) -> str:
        """Which plug-in failed at frame ``index``, and why; empty where none did."""
        return self._failures.get(index, "")

    def _with_failure(self, estimate: FrameEstimate) -> FrameEstimate:
        """The answer for a frame in which plug-ins failed says so, and is not relied on."""
        failure = self._failures.get(estimate.index)
        if failure is None:
            return estimate
        return replace(
            estimate,
            status=Status.UNCERTAIN if estimate.status is Status.TRACKED else estimate.status,
            reason="; ".join(filter(None, (failure, estimate.reason))),
            confidence=estimate.confidence / 2,
            failure=failure,
        )

    def result(self) -> ObjectModel:
        """The object as it is known now: one textured mesh."""
        if self._solver is None:
            raise RuntimeError("there is no object before the first step")
        with self._settings.in_force():
            return self._solver.result(self._state)

    @property
    def can_refine(self) -> bool:
        """Whether the solver can look at the whole video once more; known from the first frame on."""
        return isinstance(self._solver, RefiningSolver)

    def refine(self) -> None:
        """Solve everything once more over what is known of the whole video.

        A focal length that nobody gave may be solved too: ``camera`` is then another one, for the refined answers.
        ``step`` is over then: ``revisit`` takes the frames again, and ``result`` gives the final object.

        Raises:
            RuntimeError: If the solver cannot, see ``can_refine``.
        """
        with self._settings.in_force(), measured("map") as watch:
            self._state = self._refining().refine(self._state)
        self.refining = watch.times
        self._camera = getattr(self._state, "camera", self._camera)
        self._refined = True

    def revisit(self, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]) -> FrameEstimate:
        """Answer for a frame once more, against the final object. Frames come in order of time.

        Args:
            frame: The frame.
            mask: Its initial mask as it was, see ``initial_mask``.
            T_cam_obj: ``(4, 4)`` the causal answer.

        Raises:
            PluginError: If a plug-in fails; the causal answer then stands, and the next frame may be asked for.
            RuntimeError: Before ``refine``.
        """
        solver = self._refining()
        if not self._refined:
            raise RuntimeError("frames are revisited after refine")
        try:
            with self._settings.in_force(), measured("solve") as watch:
                self._state, estimate = solver.revisit(self._state, frame, mask, T_cam_obj)
        except PluginFailure as error:
            raise error.at(_label(frame)) from error.__cause__
        return _timed(self._with_failure(replace(estimate, refined=True)), watch, frame)

    def _refining(self) -> RefiningSolver[Any]:
        if not isinstance(self._solver, RefiningSolver):
            raise RuntimeError(f"the solver {self.config.solver.name} cannot refine, or has not started")
        return self._solver


def build_encoder(config: PipelineConfig) -> FeatureEncoder:
    """The feature encoder that a configuration names, under guard.

    Raises:
        PluginError: If it is unknown or broken.
    """
    label = plugin_label(FEATURES, config.features.name)
    with threads_kept(), process_kept(torch.device("cpu")):
        return cast(FeatureEncoder, GuardedEncoder(build_plugin(FEATURES, config.features), label))


def check_device(name: str) -> None:
    """Make sure that a device is there.

    Raises:
        InputError: If it is not.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device).item()
    except (RuntimeError, AssertionError) as error:
        raise InputError(f"The device '{name}' is not available on this machine; use {_CPU}.") from error


def _timed(estimate: FrameEstimate, watch: Stopwatch, frame: Frame) -> FrameEstimate:
    stages = watch.times + StageTimes(decode=frame.decoding)
    return replace(estimate, stages=stages, seconds=stages.whole)


def _label(frame: Frame) -> str:
    return frame.name or f"frame {frame.index}"
