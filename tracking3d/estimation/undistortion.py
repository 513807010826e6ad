"""A solver for a distorting lens: it sees undistorted images, and its estimates are for the original ones.

Everything around the solver, the mask tracker, prompts and answers, is in pixels of the pictures that were taken. Poses
and the solver's own state are of the pinhole camera.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, Generic, Self

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource, ObjectModel
from tracking3d.estimation.solver import (
    Gap,
    ModelCoverage,
    PhotoEstimates,
    PhotoSet,
    RefinedStart,
    RefiningSolver,
    Solver,
    State,
)
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.lens import Lens


def undistort_solver(lens: Lens | None, solver: Solver[Any]) -> Solver[Any]:
    """The solver behind a lens; the solver itself if there is no distortion."""
    if lens is None:
        return solver
    complete = isinstance(solver, RefiningSolver)
    return (CompleteUndistortingSolver if complete else UndistortingSolver)(lens, solver)


class UndistortingSolver(Generic[State]):
    """See `undistort_solver`, and `tracking3d.estimation.solver.Solver` for the methods."""

    def __init__(self, lens: Lens, solver: Any) -> None:
        self._lens, self._solver = lens, solver

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[State, FrameEstimate]:
        """See `Solver.init`."""
        state, estimate = self._solver.init(self._frame(frame), self._mask(mask))
        return state, self._answer(estimate, mask)

    def step(self, state: State, frame: Frame, mask: MaskEstimate) -> tuple[State, FrameEstimate]:
        """See `Solver.step`."""
        state, estimate = self._solver.step(state, self._frame(frame), self._mask(mask))
        return state, self._answer(estimate, mask)

    def result(self, state: State) -> ObjectModel:
        """See `Solver.result`."""
        model: ObjectModel = self._solver.result(state)
        return model

    def _frame(self, frame: Frame) -> Frame:
        return replace(frame, image=self._lens.undistort(frame.image))

    def _mask(self, mask: MaskEstimate) -> MaskEstimate:
        occluder = None if mask.occluder is None else self._lens.mask_to_pinhole(mask.occluder)
        if mask.mask is None:
            return replace(mask, occluder=occluder)
        pinhole = self._lens.mask_to_pinhole(mask.mask.astype(np.float32))
        return replace(mask, mask=pinhole, occluder=occluder)

    def _answer(self, estimate: FrameEstimate, mask: MaskEstimate | None = None) -> FrameEstimate:
        """An estimate for the original images; the inputs come back unchanged."""
        initial = mask.found if mask is not None else self._seen(estimate.initial_mask)
        handed_back = estimate.mask_source is MaskSource.INITIAL and initial is not None
        answered = initial if handed_back else self._seen(estimate.mask)
        assert answered is not None
        return replace(
            estimate,
            mask=answered,
            initial_mask=initial,
            probability=None
            if estimate.probability is None
            else self._lens.mask_to_picture(estimate.probability),
            revised=tuple(self._answer(earlier) for earlier in estimate.revised),
        )

    def _seen(self, mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        return None if mask is None else self._lens.mask_to_picture(mask)


class CompleteUndistortingSolver(UndistortingSolver[State]):
    """Of a solver that refines and can be steered, too; see `RefiningSolver`."""

    def refine(self, state: State) -> State:
        """See `RefiningSolver.refine`."""
        refined: State = self._solver.refine(state)
        return refined

    def refine_frame(
        self, state: State, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[State, FrameEstimate]:
        """See `RefiningSolver.refine_frame`."""
        state, estimate = self._solver.refine_frame(state, self._frame(frame), self._mask(mask), T_cam_obj)
        return state, self._answer(estimate, mask)

    def continue_refinement(self, state: State, start: RefinedStart) -> State | None:
        """See `RefiningSolver.continue_refinement`."""
        continued: State | None = self._solver.continue_refinement(state, start)
        return continued

    def keep_frame(self, state: State, frame: Frame, T_cam_obj: NDArray[np.float64]) -> State:
        """See `RefiningSolver.keep_frame`."""
        kept: State = self._solver.keep_frame(state, self._frame(frame), T_cam_obj)
        return kept

    def keyframe_poses(self, state: State) -> Mapping[int, NDArray[np.float64]]:
        """See `RefiningSolver.keyframe_poses`."""
        poses: Mapping[int, NDArray[np.float64]] = self._solver.keyframe_poses(state)
        return poses

    def begin_extension(
        self, state: State, confidence: Mapping[int, float]
    ) -> tuple[State, ModelCoverage] | None:
        """See `RefiningSolver.begin_extension`."""
        begun: tuple[State, ModelCoverage] | None = self._solver.begin_extension(state, confidence)
        return begun

    def extend(self, state: State, gap: Gap) -> tuple[State, list[FrameEstimate]]:
        """See `RefiningSolver.extend`; the estimates' masks are those of the pinhole camera."""
        frames = ((self._frame(frame), self._mask(mask)) for frame, mask in gap.frames)
        extended: tuple[State, list[FrameEstimate]] = self._solver.extend(
            state, replace(gap, anchor=self._frame(gap.anchor), frames=frames)
        )
        return extended

    def end_extension(self, state: State, found: Collection[int], last: int) -> State:
        """See `RefiningSolver.end_extension`."""
        ended: State = self._solver.end_extension(state, found, last)
        return ended

    def start_from(self, state: State, poses: Mapping[int, NDArray[np.float64]]) -> State:
        """See `RefiningSolver.start_from`; poses are those of the pinhole camera in any case."""
        started: State = self._solver.start_from(state, poses)
        return started

    def has_points(self, state: State, ended: bool) -> bool:
        """See `RefiningSolver.has_points`."""
        known: bool = self._solver.has_points(state, ended)
        return known

    def start_from_photos(self, state: State, photos: PhotoSet) -> tuple[State, PhotoEstimates]:
        """See `RefiningSolver.start_from_photos`; the estimates' masks are those of the pinhole camera."""

        def read(indices: Collection[int]) -> Iterator[tuple[Frame, MaskEstimate]]:
            return ((self._frame(frame), self._mask(mask)) for frame, mask in photos.read(indices))

        begun: tuple[State, PhotoEstimates] = self._solver.start_from_photos(
            state, replace(photos, read=read)
        )
        return begun

    def restart_backwards(
        self, state: State, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
    ) -> State:
        """See `RefiningSolver.restart_backwards`."""
        turned: State = self._solver.restart_backwards(state, self._frame(frame), number, T_cam_obj)
        return turned

    def trust_mask(self, state: State, frame: Frame, mask: NDArray[np.bool_]) -> State:
        """See `RefiningSolver.trust_mask`."""
        seen = self._lens.mask_to_pinhole(mask)
        trusted: State = self._solver.trust_mask(state, self._frame(frame), seen)
        return trusted

    def for_live_source(self) -> Self:
        """See `RefiningSolver.for_live_source`."""
        return type(self)(self._lens, self._solver.for_live_source())

    def finish_background_work(self, state: State) -> tuple[State, FrameEstimate | None]:
        """See `RefiningSolver.finish_background_work`."""
        state, found = self._solver.finish_background_work(state)
        return state, None if found is None else self._answer(found)
