"""One object tracked through one video: the parts that a configuration names, and the state between frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.arguments import check_frame, check_session
from tracking3d.config.camera import warn_of_unlikely
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.correction import corrects
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status, unanswered
from tracking3d.estimation.solver import RefiningSolver, Solver, SteeredSolver
from tracking3d.estimation.undistorting import behind
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate, Prompt, pixels
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.lens import Lens
from tracking3d.mask_tracking import PromptedTracker
from tracking3d.object_files import known_object, select_camera
from tracking3d.parts import SOLVERS, build_encoder, build_solver, check_turns, chosen_renderer, with_times
from tracking3d.plugins.guard import PluginFailure
from tracking3d.presented import Presented
from tracking3d.process_settings import OwnSettings, RandomState
from tracking3d.prompts import check_prompt_fits
from tracking3d.stages import StageTimes, measured


class Session:
    """One object tracked through one video: ``step`` takes each frame, ``result`` gives the object.

    The process's threads and random numbers are the session's only while it works; in between they are the caller's.

    Args:
        config: The pipeline.
        prompt: The object in the first frame; None takes the mask tracker's own first mask, or finds what is known.
        intrinsics: fx, fy, cx, cy that the source knows of, in pixels; the configuration wins over them.
        intrinsics_origin: Where they come from, in words.
        encoder: A feature encoder that several sessions share, see `build_encoder`; one of its own if None.

    Attributes:
        config: The pipeline.
        renderer: What renders, and why, see `tracking3d.rendering.backend.choose_backend`.
        initial_mask: What the solver was given for the latest frame: the mask tracker's answer, or what stands in.
        corrected: Whether the latest answer was handed back to the mask tracker.
        coming: The frame of the ``step`` after the next, where it is there: the mask tracker may begin with it.
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
        self._known = known_object(config)
        runtime = config.runtime
        self.renderer = chosen_renderer(runtime)
        self.config = config
        self._prompt = prompt
        self._intrinsics = intrinsics, intrinsics_origin
        self._settings = OwnSettings(self.renderer, runtime.device, runtime.seed)
        self._replaying = OwnSettings(self.renderer, runtime.device, runtime.seed)
        with self._settings.in_force():
            self._tracker = PromptedTracker(config.tracker, prompt)
            self._encoder = build_encoder(config) if encoder is None else encoder
        self._solver: Solver[Any] | None = None
        self._state: Any = None
        self._camera: Camera | None = None
        self._first: Frame | None = None
        self._presented, self._latest = Presented(0), 0
        self.initial_mask = MaskEstimate(None)
        self.corrected = False
        self.coming: Frame | None = None
        self._last_pose = self._first_pose = np.eye(4)
        self._failures: dict[int, str] = {}
        self._refined = False
        self.refining = StageTimes()

    @property
    def camera(self) -> Camera:
        """The camera of the full frame, known from the first frame on."""
        if self._camera is None:
            raise RuntimeError("the camera is known after the first step")
        return self._camera

    def step(self, frame: Frame, prompt: Prompt | None = None) -> FrameEstimate:
        """Track the object in the next frame; the first call starts on it.

        Frames from before the first one may follow the last, the nearest first: they are tracked backwards from the
        first one, with all that was learnt since.

        Args:
            frame: The frame.
            prompt: What the object is in this frame, where somebody has said so: the mask tracker is set on
                it, and the solver trusts the mask that it makes. Not for the first frame.

        Raises:
            InputError: If this is no `Frame` of uint8 RGB, the first one has no object, another size than the first, or
                the solver cannot track backwards.
            PluginError: If a plug-in fails: in the first frame, or with ``runtime.on_plugin_failure`` ``stop`` in
                any. With ``continue`` a later frame is answered with what there is, and ``failure`` says why.
            RuntimeError: After ``refine``.
        """
        if self._refined:
            raise RuntimeError("there is no further step after refine")
        check_frame(frame)
        try:
            with self._settings.in_force(), measured("solve") as watch:
                estimate = self._start(frame) if self._solver is None else self._go_on(frame, prompt)
        except PluginFailure as error:
            raise error.at(frame.label) from error.__cause__
        return with_times(estimate, watch, frame)

    def _start(self, frame: Frame) -> FrameEstimate:
        solver = self._begun(frame)
        if self._prompt is not None:
            check_prompt_fits(self._prompt, frame)
        mask = self._tracker.start(frame)
        self._state, estimate = solver.init(frame, mask)
        self._solver, self.initial_mask = solver, mask
        self._last_pose = self._first_pose = estimate.T_cam_obj
        if self._tracker.waits:
            self._hand_back(frame, estimate)
        return estimate

    def _begun(self, first: Frame) -> Solver[Any]:
        """The solver for a video that begins with ``first``; the camera is set for it, too."""
        height, width = first.size
        self._camera = select_camera(self.config, width, height, *self._intrinsics)
        warn_of_unlikely(self._camera)
        self._first, self._presented, self._latest = first, Presented(first.index), first.index
        solver = build_solver(self.config, self._camera, self._encoder, self._known)
        return behind(self._camera.lens, solver)

    @property
    def state_classes(self) -> tuple[type, ...]:
        """The classes of what `kept` gives, beside arrays, tensors and plain values."""
        own: tuple[type, ...] = getattr(SOLVERS[self.config.solver.name], "state_classes", ())
        return (Camera, Lens, MaskEstimate, Presented, RandomState, StageTimes, *own)

    def kept(self) -> dict[str, Any]:
        """All that another session needs to go on after the latest frame, see `resume`; its parts never change."""
        return {
            "solver": self._state,
            "camera": self._camera,
            "initial_mask": self.initial_mask,
            "last_pose": self._last_pose,
            "steering": (self._first_pose, self._presented, self._latest, self._tracker.anew),
            "refined": self._refined,
            "refining": self.refining,
            "random": self._settings.random,
            "tracker": self._tracker.state(),
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
        if steering := kept.get("steering"):  # an older version kept none
            self._first_pose, self._presented, self._latest, self._tracker.anew = steering
        self.refining, self._settings.random = kept["refining"], kept["random"]
        if self._tracker.can_resume and not self._refined:
            with self._settings.in_force():
                self._tracker.restore(first, kept["tracker"])

    @property
    def replays(self) -> bool:
        """Whether the mask tracker has to see the frames again after `resume`."""
        return not self._tracker.can_resume and not self._refined

    def replay(
        self, frame: Frame, first: bool, correction: NDArray[np.bool_] | None, prompt: Prompt | None = None
    ) -> MaskEstimate | None:
        """Take the mask tracker alone through a frame that is answered already.

        Args:
            frame: The frame.
            first: Whether it is the first one.
            correction: ``(H, W)`` what was handed back to the tracker after it, if anything was.
            prompt: What ``step`` was given with it.

        Returns:
            The tracker's answer; None where it fails.
        """
        answer = None
        try:
            with self._replaying.in_force():
                answer = self._tracker.start(frame) if first else self._tracker.step(frame, prompt)
                if correction is not None:
                    self._tracker.correct(frame, correction)
        except PluginFailure as error:
            if first:
                raise error.at(frame.label) from error.__cause__
        return answer

    def _go_on(self, frame: Frame, prompt: Prompt | None) -> FrameEstimate:
        if frame.size != (self.camera.height, self.camera.width):
            raise InputError(
                f"{frame.label} has {pixels(frame.size)} pixels but the first frame "
                f"{pixels((self.camera.height, self.camera.width))}; all frames must have one size."
            )
        failures = []
        self.corrected, solver = False, self._facing(frame)
        try:
            mask = self._tracker.step(frame, prompt)
            self._tracker.announce(self.coming)
        except PluginFailure as error:
            failures.append(self._excused(error))
            mask = replace(self.initial_mask, score=0.0, reason=error.reason)
        self.initial_mask = mask
        try:
            shown = self._presented.number(frame)
            if prompt is not None and mask.found is not None and isinstance(solver, SteeredSolver):
                self._state = solver.trusting(self._state, shown, mask.found)
            self._state, estimate = solver.step(self._state, shown, mask)
            estimate = self._presented.index(estimate)
        except PluginFailure as error:
            failures.append(self._excused(error))
            estimate = unanswered(frame, mask, self._last_pose)
        self._last_pose, self._camera = estimate.T_cam_obj, estimate.camera or self._camera
        for answer in (*estimate.revised, estimate):
            self._first_pose = answer.T_cam_obj if answer.index == self._presented.first else self._first_pose
        if prompt is None:
            try:
                self._hand_back(frame, estimate)
            except PluginFailure as error:
                failures.append(self._excused(error))
        if failures:
            self._failures[frame.index] = "; ".join(failures)
        revised = tuple(self._with_failure(earlier) for earlier in estimate.revised)
        return self._with_failure(replace(estimate, revised=revised))

    def _hand_back(self, frame: Frame, estimate: FrameEstimate) -> None:
        """Set the mask tracker on an answer that is sure and unlike its own; on the first one, where it waits."""
        corrected = self.config.solver.correct_tracker and self._tracker.can_correct and corrects(estimate)
        if corrected or (self._tracker.waits and estimate.status is not Status.LOST):
            self.corrected = True
            self._tracker.correct(frame, estimate.mask)

    def _facing(self, frame: Frame) -> Solver[Any]:
        """The solver, turned back to the first frame where this one is the first from before it."""
        solver, first = self._solver, self._first
        assert solver is not None and first is not None
        if self._presented.last is None:
            if frame.index >= first.index:
                self._latest = frame.index
            else:
                check_turns(self.config)
                assert isinstance(solver, SteeredSolver)
                self._presented = Presented(first.index, self._latest)
                self._state = solver.turned_back(self._state, first, self._latest, self._first_pose)
        return solver

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
                shown = self._presented.number(frame)
                self._state, estimate = solver.revisit(self._state, shown, mask, T_cam_obj)
                estimate = self._presented.index(estimate)
        except PluginFailure as error:
            raise error.at(frame.label) from error.__cause__
        return with_times(self._with_failure(replace(estimate, refined=True)), watch, frame)

    def _refining(self) -> RefiningSolver[Any]:
        if not isinstance(self._solver, RefiningSolver):
            raise RuntimeError(f"the solver {self.config.solver.name} cannot refine, or has not started")
        return self._solver
