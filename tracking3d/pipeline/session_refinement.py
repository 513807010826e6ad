"""The final refinement of a session: the whole model once more, then every frame with it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.estimate import FrameEstimate, mark_failed
from tracking3d.estimation.refined_start import RefinedStart
from tracking3d.estimation.solver import ContinuingSolver, RefiningSolver, Solver
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.components import add_times
from tracking3d.pipeline.frame_order import FrameOrder
from tracking3d.plugins.guard import PluginFailure
from tracking3d.runtime.isolation import IsolatedRuntime
from tracking3d.runtime.stage_times import StageTimes, measure


class SessionRefinement:
    """What `tracking3d.Session` does after its last ``step``; see there for the attributes."""

    config: PipelineConfig
    refining: StageTimes
    _solver: Solver[Any] | None
    _state: Any
    _camera: Camera | None
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
            self._state = self._refining().refine(self._state)
        self.refining = watch.times
        self._camera = getattr(self._state, "camera", self._camera)
        self._refined = True

    def continue_refinement(self, start: RefinedStart) -> bool:
        """Start from an earlier refinement, in place of `refine`: only the frames that have changed are refined.

        Args:
            start: Poses of the frames whose estimates stay, and the surface.

        Returns:
            Whether that is possible; if not, nothing has changed.
        """
        solver = self._solver
        if not isinstance(solver, ContinuingSolver) or self._presented.last is not None:
            return False
        with self._settings.in_force(), measure("map") as watch:
            state = solver.continue_refinement(self._state, start)
        if state is None:
            return False
        self.refining, self._state, self._camera, self._refined = watch.times, state, start.camera, True
        return True

    def keep_frame(self, frame: Frame, T_cam_obj: NDArray[np.float64]) -> None:
        """Take a frame whose refined pose ``(4, 4)`` stands, before the next one is refined."""
        if isinstance(self._solver, ContinuingSolver):
            with self._settings.in_force():
                self._state = self._solver.keep_frame(self._state, frame, T_cam_obj)

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
        solver = self._refining()
        if not self._refined:
            raise RuntimeError("frames are revisited after refine")
        try:
            with self._settings.in_force(), measure("solve") as watch:
                shown = self._presented.number(frame)
                self._state, estimate = solver.refine_frame(self._state, shown, mask, T_cam_obj)
                estimate = self._presented.index(estimate)
        except PluginFailure as error:
            raise error.at(frame.label) from error.__cause__
        estimate = replace(estimate, refined=True)
        if failure := self._failures.get(estimate.index):
            estimate = mark_failed(estimate, failure)
        return add_times(estimate, watch, frame)

    def _refining(self) -> RefiningSolver[Any]:
        if not isinstance(self._solver, RefiningSolver):
            raise RuntimeError(f"the solver {self.config.solver.name} cannot refine, or has not started")
        return self._solver
