"""One object tracked through one video: the parts that a configuration names, and the state between frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.camera import warn_of_unlikely
from tracking3d.config.models import AUTO, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import (
    CARRIED,
    FrameEstimate,
    ObjectModel,
    Status,
    corrects,
    lost_estimate,
    mark_failed,
    stands_alone,
    with_initial_mask,
)
from tracking3d.estimation.solver import RefiningSolver, Solver
from tracking3d.estimation.undistortion import Undistortion
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate, Prompt, pixels
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.lens import Lens
from tracking3d.pipeline.components import (
    SOLVERS,
    add_times,
    build_detector,
    build_encoder,
    build_solver,
    check_backward_tracking,
    select_renderer,
)
from tracking3d.pipeline.frame_reading import FrameOrder
from tracking3d.pipeline.known_object import load_known_object, select_camera
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.pipeline.session_refinement import SessionRefinement
from tracking3d.pipeline.tracker_selection import choose_tracker
from tracking3d.pipeline.validation import check_frame, check_session
from tracking3d.plugins.guard import PluginFailure
from tracking3d.runtime.isolation import IsolatedRuntime, RandomState
from tracking3d.runtime.stage_times import StageTimes, measure
from tracking3d.trackers.prompts.prompt import check_prompt_fits


class Session(SessionRefinement):
    """One object tracked through one video: ``step`` takes each frame, ``result`` gives the object.

    The process's threads and random numbers are the session's only while it works; in between they are the caller's.

    Args:
        config: The pipeline; the size of the first frame decides on the mask tracker ``auto``.
        prompt: The object in the first frame; None takes the mask tracker's own first mask, or finds the known object.
        intrinsics: fx, fy, cx, cy that the source knows of, in pixels; the configuration wins over them.
        intrinsics_origin: Where they come from, in words.
        encoder: A feature encoder that several sessions share, see `build_encoder`; one of its own if None.
        live: Whether frames come as they are filmed and do not wait: long work is then done in another thread, and
            the result depends on how fast the machine is.

    Attributes:
        config: The pipeline; from the first frame on, its mask tracker is never ``auto``.
        renderer: What renders, and why, see `tracking3d.rendering.backend.choose_backend`.
        initial_mask: The solver's input for the latest frame: the mask tracker's estimate, or its replacement.
        corrected: Whether the latest estimate was fed back to the mask tracker.
        coming: The frame of the next ``step``, if it is known: the mask tracker may begin with it.
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
        live: bool = False,
    ) -> None:
        check_session(config, prompt, intrinsics)
        self._known = load_known_object(config)
        runtime = config.runtime
        self.renderer = select_renderer(runtime)
        self.config = config
        self._prompt, self._live = prompt, live
        self._intrinsics = intrinsics, intrinsics_origin
        self._settings = IsolatedRuntime(self.renderer, runtime.device, runtime.seed)
        self._replaying = IsolatedRuntime(self.renderer, runtime.device, runtime.seed)
        with self._settings.in_force():
            if config.tracker.name != AUTO:
                self._tracker = PromptedTracker(config.tracker, prompt)
            self._encoder = build_encoder(config) if encoder is None else encoder
            self._detector = build_detector(config)
        self._solver: Solver[Any] | None = None
        self._state: Any = None
        self._camera: Camera | None = None
        self._undistortion = Undistortion(None)
        self._first: Frame | None = None
        self._presented, self._latest = FrameOrder(0), 0
        self.initial_mask = MaskEstimate(None)
        self.corrected = False
        self.coming: Frame | None = None
        self._last_pose = self._first_pose = np.eye(4)
        self._spare = -1
        self._failures: dict[int, str] = {}
        self._late: list[FrameEstimate] = []
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
            prompt: The object in this frame, if it is corrected here: the mask tracker is re-anchored to
                it, and the solver trusts the mask that it makes. Not for the first frame.

        Raises:
            InputError: If this is no `Frame` of uint8 RGB, the first one has no object, another size than the first, or
                the solver cannot track backwards.
            PluginError: If a plug-in fails: in the first frame, or with ``runtime.on_plugin_failure`` ``stop`` in
                any. With ``continue`` a later frame is estimated with what there is, and ``failure`` says why.
            RuntimeError: After ``refine``.
        """
        if self._refined:
            raise RuntimeError("there is no further step after refine")
        check_frame(frame)
        try:
            with self._settings.in_force(), measure("solve") as watch:
                if self._solver is None:
                    estimate = self._start(frame)
                else:
                    solver = self._solver_for(frame)
                    unaided = self._spare > 0 and prompt is None
                    found = self._step_unaided(solver, frame) if unaided else None
                    estimate = found or self._step(solver, frame, prompt)
                    estimate = self._remember(frame, estimate, corrected=prompt is not None)
        except PluginFailure as error:
            raise error.at(frame.label) from error.__cause__
        return add_times(estimate, watch, frame)

    def _step(self, solver: Solver[Any], frame: Frame, prompt: Prompt | None) -> FrameEstimate:
        mask = self._follow_mask(frame, prompt)
        try:
            shown = self._undistortion.frame(self._presented.number(frame))
            if prompt is not None:
                self._trust(shown, mask)
            self._state, estimate = solver.step(self._state, shown, self._undistortion.mask(mask))
            return self._of_picture(estimate, mask)
        except PluginFailure as error:
            self._tolerate(frame, error)
            return lost_estimate(frame, mask, self._last_pose)

    def _step_unaided(self, solver: Solver[Any], frame: Frame) -> FrameEstimate | None:
        """Take a frame with the last one's mask, carried into it; None if the mask tracker is needed after all."""
        before = self._undistortion.mask(self.initial_mask)
        if before.found is None or not isinstance(solver, RefiningSolver):
            return None
        shown = self._undistortion.frame(self._presented.number(frame))
        try:
            if (moved := solver.carry_mask(self._state, shown, before.found)) is None or not moved.any():
                return None
            seen = replace(before, mask=moved.astype(np.float32), carried=True)
            state, estimate = solver.step(self._state, shown, seen)
            initial = self._undistortion.estimate(estimate).initial_mask
            if initial is None or not stands_alone(estimate):
                return None
            self._tracker.skip(frame, initial)
        except PluginFailure:  # `_step` reports it
            return None
        self._state, self.corrected = state, False
        self.initial_mask = replace(self.initial_mask, mask=initial.astype(np.float32), carried=True)
        estimate = replace(estimate, diagnostics={**estimate.diagnostics, CARRIED: 1.0})
        return self._of_picture(estimate, self.initial_mask)

    def _start(self, frame: Frame) -> FrameEstimate:
        solver = self._prepare(frame)
        if self._prompt is not None:
            check_prompt_fits(self._prompt, frame)
        mask = self._tracker.start(frame)
        self._state, estimate = solver.init(self._undistortion.frame(frame), self._undistortion.mask(mask))
        estimate = self._of_picture(estimate, mask)
        self._solver, self.initial_mask = solver, mask
        self._last_pose = self._first_pose = estimate.T_cam_obj
        if self._tracker.waits:
            self._feed_back(frame, estimate)
        return estimate

    def _prepare(self, first: Frame) -> Solver[Any]:
        """The solver for a video that begins with ``first``; camera and mask tracker are set for it, too."""
        height, width = first.size
        if self.config.tracker.name == AUTO:
            self.config, _ = choose_tracker(self.config, None, self._live, first.size)
            self._tracker = PromptedTracker(self.config.tracker, self._prompt)
        self._camera = select_camera(self.config, width, height, *self._intrinsics)
        warn_of_unlikely(self._camera)
        self._first, self._presented, self._latest = first, FrameOrder(first.index), first.index
        self._undistortion = Undistortion(self._camera.lens)
        solver = build_solver(self.config, self._camera, self._encoder, self._detector, self._known)
        return solver.for_live_source() if self._live and isinstance(solver, RefiningSolver) else solver

    @property
    def state_classes(self) -> tuple[type, ...]:
        """The classes of what `state_dict` gives, beside arrays, tensors and plain values."""
        own: tuple[type, ...] = getattr(SOLVERS[self.config.solver.name], "state_classes", ())
        return (Camera, Lens, MaskEstimate, FrameOrder, RandomState, StageTimes, *own)

    def state_dict(self) -> dict[str, Any]:
        """The immutable state that another session continues from, see `load_state_dict`."""
        self._late += self._finish_background_work()
        return {
            "solver": self._state,
            "camera": self._camera,
            "initial_mask": self.initial_mask,
            "last_pose": self._last_pose,
            "steering": (self._first_pose, self._presented, self._latest, self._tracker.restarted),
            "spare": self._spare,
            "refined": self._refined,
            "refining": self.refining,
            "random": self._settings.random,
            "tracker": self._tracker.state(),
        }

    def finish_background_work(self) -> list[FrameEstimate]:
        """Wait for what a live session still computes; call it after the last ``step``.

        Returns:
            Better estimates of earlier frames, in order; mostly none.
        """
        late, self._late = self._late + self._finish_background_work(), []
        return late

    def _finish_background_work(self) -> list[FrameEstimate]:
        if not (self._live and isinstance(self._solver, RefiningSolver)):
            return []
        with self._settings.in_force():
            self._state, found = self._solver.finish_background_work(self._state)
        if found is None:
            return []
        found = self._presented.index(self._undistortion.estimate(found))
        self._last_pose, self._camera = found.T_cam_obj, found.camera or self._camera
        return [self._with_failure(one) for one in (*found.revised, replace(found, revised=()))]

    def load_state_dict(self, first: Frame, kept: Mapping[str, Any], failures: Mapping[int, str]) -> None:
        """Restore a saved session (`state_dict`), instead of starting on a first frame.

        If `replays`, pass the frames up to the one after which it was saved to `replay` before the next
        ``step``.

        Args:
            first: The first frame.
            kept: The value of `state_dict`.
            failures: Which plug-ins failed in which frames.

        Raises:
            PluginError: If the mask tracker cannot be restored.
        """
        with self._settings.in_force():
            self._solver = self._prepare(first)
        self._state, self._camera = kept["solver"], kept["camera"]
        self.initial_mask, self._last_pose = kept["initial_mask"], kept["last_pose"]
        self._refined, self._failures = kept["refined"], dict(failures)
        self._first_pose, self._presented, self._latest, self._tracker.restarted = kept["steering"]
        self._spare = kept.get("spare", -1)
        self.refining, self._settings.random = kept["refining"], kept["random"]
        if self._tracker.can_resume and not self._refined:
            with self._settings.in_force():
                self._tracker.restore(first, kept["tracker"])

    @property
    def replays(self) -> bool:
        """Whether the mask tracker has to see the frames again after `load_state_dict`."""
        return not self._tracker.can_resume and not self._refined

    def replay(
        self,
        frame: Frame,
        first: bool,
        correction: NDArray[np.bool_] | None,
        prompt: Prompt | None = None,
        carried: NDArray[np.bool_] | None = None,
    ) -> MaskEstimate | None:
        """Take the mask tracker alone through a frame that is estimated already.

        Args:
            frame: The frame.
            first: Whether it is the first one.
            correction: ``(H, W)`` the feedback to the tracker after it, if any.
            prompt: What ``step`` was given with it.
            carried: ``(H, W)`` its initial mask, if the tracker was not asked.

        Returns:
            The tracker's estimate; None if it fails or was not asked.
        """
        estimate = None
        try:
            with self._replaying.in_force():
                if carried is not None:
                    self._tracker.skip(frame, carried)
                    return None
                estimate = self._tracker.start(frame) if first else self._tracker.step(frame, prompt)
                if not first:
                    self._tracker.announce(self.coming)
                if correction is not None:
                    self._tracker.correct(frame, correction)
        except PluginFailure as error:
            if first:
                raise error.at(frame.label) from error.__cause__
        return estimate

    def _follow_mask(self, frame: Frame, prompt: Prompt | None) -> MaskEstimate:
        """The mask tracker's estimate; if it fails, the one before, without a score."""
        self.corrected = False
        try:
            mask = self._tracker.step(frame, prompt)
            if self._spare < 0:  # else it is not known yet whether the tracker is asked next
                self._tracker.announce(self.coming)
        except PluginFailure as error:
            self._tolerate(frame, error)
            mask = replace(self.initial_mask, score=0.0, reason=error.reason, carried=False)
        self.initial_mask = mask
        return mask

    def _count_spare(self, estimate: FrameEstimate) -> int:
        """For how many frames after this one the mask tracker need not be asked; -1 if it need be twice at least."""
        wanted = self.config.object
        may_skip = wanted.mask_interval > 1 and self._tracker.can_skip and not wanted.trust_masks
        if not may_skip or estimate.index in self._failures or not stands_alone(estimate):
            return -1
        if self.initial_mask.carried:
            return self._spare - 1
        return wanted.mask_interval - 1 if self._spare >= 0 else 0

    def _trust(self, shown: Frame, mask: MaskEstimate) -> None:
        """Have the solver trust the mask of a corrected frame, which is ``shown`` to it next."""
        if mask.found is not None and isinstance(self._solver, RefiningSolver):
            trusted = self._undistortion.binary(mask.found)
            self._state = self._solver.trust_mask(self._state, shown, trusted)

    def _of_picture(self, estimate: FrameEstimate, mask: MaskEstimate) -> FrameEstimate:
        """The solver's estimate as one of the frame as it was taken; ``mask`` is its initial mask."""
        estimate = self._presented.index(self._undistortion.estimate(estimate, mask))
        estimate = replace(estimate, occluder=mask.occluder)
        return with_initial_mask(estimate) if self.config.object.trust_masks else estimate

    def _remember(self, frame: Frame, estimate: FrameEstimate, corrected: bool) -> FrameEstimate:
        """Keep what later frames need, and feed back to the mask tracker unless this frame ``corrected`` it."""
        self._last_pose, self._camera = estimate.T_cam_obj, estimate.camera or self._camera
        for one in (*estimate.revised, estimate):
            self._first_pose = one.T_cam_obj if one.index == self._presented.first else self._first_pose
        spare, self._spare = self._spare, self._count_spare(estimate)
        try:
            if not corrected:
                self._feed_back(frame, estimate)
            if spare >= 0 and self._spare < 1:
                self._tracker.announce(self.coming)
        except PluginFailure as error:
            self._tolerate(frame, error)
        revised = tuple(map(self._with_failure, estimate.revised))
        return self._with_failure(replace(estimate, revised=revised))

    def _solver_for(self, frame: Frame) -> Solver[Any]:
        """The solver, restarted backwards if this frame is the first one before the prompt frame."""
        if frame.size != (self.camera.height, self.camera.width):
            raise InputError(
                f"{frame.label} has {pixels(frame.size)} pixels but the first frame "
                f"{pixels((self.camera.height, self.camera.width))}; all frames must have one size."
            )
        solver, first = self._solver, self._first
        assert solver is not None and first is not None
        if self._presented.last is None:
            if frame.index >= first.index:
                self._latest = frame.index
            else:
                check_backward_tracking(self.config)
                assert isinstance(solver, RefiningSolver)
                self._presented, self._spare = FrameOrder(first.index, self._latest), -1
                first = self._undistortion.frame(first)
                self._state = solver.restart_backwards(self._state, first, self._latest, self._first_pose)
        return solver

    def _feed_back(self, frame: Frame, estimate: FrameEstimate) -> None:
        """Re-anchor the mask tracker to a reliable estimate unlike its own, or to the first one if it waits."""
        corrected = self.config.solver.tracker_feedback and self._tracker.can_correct and corrects(estimate)
        if corrected or (self._tracker.waits and estimate.status is not Status.LOST):
            self.corrected = True
            self._tracker.correct(frame, estimate.visible_mask)

    def _tolerate(self, frame: Frame, error: PluginFailure) -> None:
        """Note why a plug-in failed in a frame, if the run continues in spite of it."""
        if self.config.runtime.on_plugin_failure == "stop":
            raise error
        before = self._failures.get(frame.index)
        self._failures[frame.index] = f"{before}; {error.reason}" if before else error.reason

    def failure_at(self, index: int) -> str:
        """Which plug-in failed at frame ``index``, and why; empty if none did."""
        return self._failures.get(index, "")

    def _with_failure(self, estimate: FrameEstimate) -> FrameEstimate:
        """The estimate for a frame in which plug-ins failed says so, and is not relied on."""
        failure = self._failures.get(estimate.index)
        return estimate if failure is None else mark_failed(estimate, failure)

    def result(self) -> ObjectModel:
        """The object as it is known now: one textured mesh."""
        if self._solver is None:
            raise RuntimeError("there is no object before the first step")
        with self._settings.in_force():
            return self._solver.result(self._state)
