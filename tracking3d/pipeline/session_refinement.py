"""The final refinement of a session: the whole model once more, then every frame with it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.estimate import FrameEstimate, mark_failed, with_initial_mask, without_masks
from tracking3d.estimation.solver import Gap, ModelCoverage, PhotoSet, RefinedStart, RefiningSolver, Solver
from tracking3d.estimation.undistortion import Undistortion
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.components import add_times
from tracking3d.pipeline.frame_reading import FrameOrder
from tracking3d.plugins.guard import PluginFailure
from tracking3d.runtime.isolation import IsolatedRuntime
from tracking3d.runtime.stage_times import StageTimes, measure


@dataclass(frozen=True, eq=False)
class Attempt:
    """What another start comes to."""

    state: Any  # the solver's state after the last frame
    order: FrameOrder  # the order in which the solver was shown the frames
    poses: Mapping[int, NDArray[np.float64]]  # the pose (4, 4) in each frame, by index
    confidence: Mapping[int, float]  # of these poses


class SessionRefinement:
    """What `tracking3d.Session` does after its last ``step``; see there for the attributes."""

    config: PipelineConfig
    refining: StageTimes
    _solver: Solver[Any] | None
    _state: Any
    _camera: Camera | None
    _undistortion: Undistortion
    _settings: IsolatedRuntime
    _presented: FrameOrder
    _refined: bool
    _failures: dict[int, str]

    @property
    def can_refine(self) -> bool:
        """Whether the solver can look at the whole video once more; known from the first frame on."""
        return isinstance(self._solver, RefiningSolver)

    def refine(self) -> None:
        """Refine the whole model with the observations of the whole video.

        A focal length that was not given may be estimated too: ``camera`` is then that of the refined estimates.
        Do not call ``step`` afterwards: ``refine_frame`` refines each frame, and ``result`` gives the final object.

        Raises:
            RuntimeError: If the solver cannot, see ``can_refine``.
        """
        with self._settings.in_force(), measure("map") as watch:
            self._state = self._refining.refine(self._state)
        self.refining += watch.times
        self._camera = getattr(self._state, "camera", self._camera)
        self._refined = True

    def begin_extension(self, confidence: Mapping[int, float]) -> ModelCoverage | None:
        """Prepare to track the object into frames that are not explained; None if the solver cannot.

        Args:
            confidence: Of the causal estimate of each frame, by index.
        """
        if not self.can_refine or not self.order_of_time:
            return None
        with self._settings.in_force():
            begun = self._refining.begin_extension(self._state, confidence)
        if begun is None:
            return None
        self._state, explained = begun
        return explained

    def extend(self, gap: Gap) -> list[FrameEstimate]:
        """Track the object through a gap, before `refine`; no estimates if a plug-in fails."""
        view = self._undistortion
        seen = replace(gap, anchor=view.frame(gap.anchor), frames=view.each(gap.frames))
        try:
            with self._settings.in_force(), measure("map") as watch:
                self._state, estimates = self._refining.extend(self._state, seen)
        except PluginFailure:
            return []
        self.refining += watch.times
        return estimates

    def end_extension(self, poses: Mapping[int, NDArray[np.float64]], last: int) -> None:
        """Refine the frames of gaps from these poses ``(4, 4)``, by index; ``last`` is the last frame of the video."""
        self._state = self._refining.end_extension(self._state, set(poses), last)
        self._state = self._refining.start_from(self._state, poses)

    @property
    def first_index(self) -> int:
        """Index of the frame that tracking started with."""
        return self._presented.first

    @property
    def order_of_time(self) -> bool:
        """Whether all frames were shown to the solver in order of time."""
        return self._presented.last is None

    @property
    def tried(self) -> int:
        """Frames that the solver has tried once more while they came, see `Mapped.tried`."""
        return int(getattr(self._state, "tried", 0))

    def attempt(
        self,
        frames: Iterable[tuple[Frame, MaskEstimate]],
        goes_on: Callable[[Mapping[int, FrameEstimate]], bool] = lambda found: True,
    ) -> Attempt | None:
        """Track the object once more from another frame, with given masks.

        Args:
            frames: Frames with their initial masks: from the start to the end of the video, then those before it
                backwards.
            goes_on: Whether the next frame is to be taken, by the estimates so far, by index.

        Returns:
            What it comes to; None if the solver cannot, a plug-in fails, or it does not go on to the end.
        """
        solver, state, first, found = self._solver, None, None, dict[int, FrameEstimate]()
        if not isinstance(solver, RefiningSolver):
            return None
        order, latest = FrameOrder(0), 0
        try:
            with self._settings.in_force(), measure("map") as watch:
                for frame, mask in self._undistortion.each(frames):
                    if first is None:
                        first, order = frame, FrameOrder(frame.index)
                        state, estimate = solver.init(frame, mask)
                    else:
                        if frame.index < first.index and order.last is None:
                            order = FrameOrder(first.index, latest)
                            T_cam_obj = found[first.index].T_cam_obj
                            state = solver.restart_backwards(state, first, latest, T_cam_obj)
                        state, estimate = solver.step(state, order.number(frame), mask)
                        estimate = order.index(estimate)
                    latest = max(latest, frame.index)
                    found |= {one.index: without_masks(one) for one in (*estimate.revised, estimate)}
                    if not goes_on(found):
                        return None
        except PluginFailure:
            return None
        self.refining += watch.times
        poses = {index: np.asarray(one.T_cam_obj, np.float64) for index, one in found.items()}
        confidence = {index: one.confidence for index, one in found.items()}
        return Attempt(state, order, poses, confidence)

    def lacks_points(self, ended: bool) -> bool:
        """Whether there is no map with points, and the solver could start from photos."""
        if not self.can_refine:
            return False
        with self._settings.in_force():
            return not self._refining.has_points(self._state, ended)

    def start_from_photos(self, photos: PhotoSet) -> tuple[Attempt | None, str]:
        """Join the frames as photos, in whatever order; see `RefiningSolver.start_from_photos`.

        Returns:
            What it comes to, None if nothing does; and which photos are not joined, in words.
        """
        if not self.can_refine:
            return None, ""
        try:
            with self._settings.in_force(), measure("map") as watch:
                read = photos.read
                seen = replace(photos, read=lambda indices: self._undistortion.each(read(indices)))
                state, made = self._refining.start_from_photos(self._state, seen)
        except PluginFailure:
            return None, ""
        self.refining += watch.times
        if not made.estimates:
            self._state = state
            return None, made.reason
        poses = {one.index: np.asarray(one.T_cam_obj, np.float64) for one in made.estimates}
        confidence = {one.index: one.confidence for one in made.estimates}
        return Attempt(state, FrameOrder(min(poses)), poses, confidence), made.reason

    def adopt(self, attempt: Attempt) -> None:
        """Continue with another start in place of the first one."""
        self._state, order = attempt.state, attempt.order
        poses = {order.number_of(index): T for index, T in attempt.poses.items()}
        self._state = self._refining.start_from(self._state, poses)
        self._presented = order
        self._camera = getattr(self._state, "camera", self._camera)

    def continue_refinement(self, start: RefinedStart) -> bool:
        """Start from an earlier refinement, in place of `refine`: only the frames that have changed are refined.

        Args:
            start: Poses of the frames whose estimates stay, and the surface.

        Returns:
            Whether that is possible; if not, nothing has changed.
        """
        if not self.can_refine or not self.order_of_time:
            return False
        with self._settings.in_force(), measure("map") as watch:
            state = self._refining.continue_refinement(self._state, start)
        if state is None:
            return False
        self.refining, self._state, self._camera, self._refined = watch.times, state, start.camera, True
        return True

    def keyframe_poses(self) -> Mapping[int, NDArray[np.float64]]:
        """Refined poses ``(4, 4)`` of keyframes after `refine`, see `RefiningSolver.keyframe_poses`."""
        return self._refining.keyframe_poses(self._state) if self.can_refine and self.order_of_time else {}

    def keep_frame(self, frame: Frame, T_cam_obj: NDArray[np.float64]) -> None:
        """Take a frame whose refined pose ``(4, 4)`` stands, before the next one is refined."""
        with self._settings.in_force():
            self._state = self._refining.keep_frame(self._state, self._undistortion.frame(frame), T_cam_obj)

    @contextmanager
    def state_unchanged(self) -> Iterator[None]:
        """The frames that are taken within leave no trace in the session."""
        state = self._state
        try:
            yield
        finally:
            self._state = state

    def refine_frame(self, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]) -> FrameEstimate:
        """Estimate for a frame once more, against the final object. Frames come in order of time.

        Args:
            frame: The frame.
            mask: Its initial mask as it was, see ``initial_mask``.
            T_cam_obj: ``(4, 4)`` the causal estimate.

        Raises:
            PluginError: If a plug-in fails; the causal estimate then stands, and the next frame may be asked for.
            RuntimeError: Before ``refine``.
        """
        solver = self._refining
        if not self._refined:
            raise RuntimeError("frames are revisited after refine")
        try:
            with self._settings.in_force(), measure("solve") as watch:
                shown = self._undistortion.frame(self._presented.number(frame))
                seen = self._undistortion.mask(mask)
                self._state, estimate = solver.refine_frame(self._state, shown, seen, T_cam_obj)
                estimate = self._presented.index(self._undistortion.estimate(estimate, mask))
        except PluginFailure as error:
            raise error.at(frame.label) from error.__cause__
        estimate = replace(estimate, refined=True)
        if self.config.object.trust_masks:
            estimate = with_initial_mask(estimate)
        if failure := self._failures.get(estimate.index):
            estimate = mark_failed(estimate, failure)
        return add_times(estimate, watch, frame)

    @property
    def _refining(self) -> RefiningSolver[Any]:
        if not isinstance(self._solver, RefiningSolver):
            raise RuntimeError(f"the solver {self.config.solver.name} cannot refine, or has not started")
        return self._solver
