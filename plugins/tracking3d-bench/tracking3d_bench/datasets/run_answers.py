"""A run folder as the estimates of a method."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.results import layout
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.stage_times import StageTimes
from tracking3d.video.image_sequence import ImageSequence
from tracking3d.video.source import parse_selection, within
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.truth import MaskFile, MaskReference, Truth

if TYPE_CHECKING:
    from tracking3d.results.point_tracking import RunScene

LEAST_SHARED = 0.5
"""Minimum share of a run's frames that the clip must contain; with fewer, common indices are a coincidence."""


def answers_of_run(folder: Path, truth: Truth, *, refined: bool = True, offset: int = 0) -> Answers:
    """The estimates of a run for the clip of ``truth``.

    A run's frame index is the position of the frame in the clip. If ``run.json`` holds a ``selection``
    ``START:STOP:STEP``, only those frames were asked for.

    Args:
        folder: The run folder.
        truth: The clip.
        refined: Take the estimates of the final refinement if there are any, else the causal ones everywhere. A
            refined estimate took the time of the causal one and an equal share of the refinement's.
        offset: Frame ``i`` of the run is frame ``i + offset`` of the clip.

    Raises:
        InputError: If it is not a run folder, or one of something else than the clip: without any frame of it, with
            few, or of another size.
    """
    run = RunReader(folder, refined)
    asked = _shift_range(parse_selection(run.description.get("selection")), offset, len(truth.frames))
    records = {record.index + offset: record for record in run.frames if record.index + offset in asked}
    _check_shared(run, records, truth, offset)
    from tracking3d.results.point_tracking import has_landmarks  # slow to import

    memory = run.description.get("peak_memory_mb")
    seconds, stages = _times(run, records)
    has_mesh = (run.mesh_folder / layout.OBJ).is_file()
    points = _RunPoints(run, len(truth.frames), offset)
    return Answers(
        origin=folder,
        asked=asked,
        answered=frozenset(records),
        held=len(run.frames),
        given=min(records),
        masks={index: MaskFile(run.mask_path(one.index)) for index, one in records.items()},
        visible_masks=_masks_in(folder, layout.visible_mask_path, records) or None,
        initial_masks=_masks_in(folder, layout.initial_mask_path, records),
        T_cam_obj={index: one.T_cam_obj for index, one in records.items() if one.has_pose},
        lost=frozenset(index for index, one in records.items() if one.status is Status.LOST),
        confidence={index: one.confidence for index, one in records.items() if math.isfinite(one.confidence)},
        seconds=seconds,
        stages=stages,
        mask_sources={n: one.mask_source for n, one in records.items() if one.mask_source is not None},
        peak_memory_mb=memory if isinstance(memory, int | float) else None,
        mesh=run.mesh if has_mesh else None,
        points=points if has_mesh else None,
        corrected_points=replace(points, images=_frames(truth, offset))
        if has_mesh and has_landmarks(run)
        else None,
        tracked=frozenset(index for index, one in records.items() if one.status is Status.TRACKED),
        free_axes={index: np.array(one.free_axis) for index, one in records.items() if one.free_axis},
    )


def _shift_range(selection: range, offset: int, count: int) -> range:
    """The frames of a clip of ``count`` frames that a selection of the run's means."""
    start = selection.start + offset
    if start < 0:
        start %= selection.step
    return within(range(start, max(selection.stop + offset, start), selection.step), count)


def _check_shared(run: RunReader, records: Mapping[int, FrameRecord], truth: Truth, offset: int) -> None:
    """Make sure that run and clip are of one video, as far as that shows."""
    camera, what = run.camera, f"The run {run.folder}"
    advice = "give the clip of the run, or --offset N if frame i of the run is frame i + N of the clip"
    if truth.camera is not None and (camera.width, camera.height) != (
        truth.camera.width,
        truth.camera.height,
    ):
        raise InputError(
            f"{what} has frames of {camera.width} x {camera.height} pixels, but the clip {truth.name} has "
            f"{truth.camera.width} x {truth.camera.height}; give the clip of the run."
        )
    if not run.frames:
        raise InputError(f"{what} has no frame of the clip {truth.name}: the run is empty; track again.")
    if len(records) < LEAST_SHARED * len(run.frames):
        first, last = run.frames[0].index + offset, run.frames[-1].index + offset
        shared = f"only {len(records)} frames" if records else "no frame"
        raise InputError(
            f"{what} has {shared} of the clip {truth.name}: its {len(run.frames)} frames are {first} to {last}, the "
            f"clip's 0 to {len(truth.frames) - 1}; {advice}."
        )


def is_refined(folder: Path) -> bool:
    """Whether a run holds refined estimates besides the causal ones.

    Raises:
        InputError: If it is not a run folder.
    """
    return any(record.refined for record in RunReader(folder).frames)


def _times(
    run: RunReader, records: Mapping[int, FrameRecord]
) -> tuple[dict[int, float], dict[int, StageTimes]]:
    """Wall time by frame, and its stages if they are known; of refined estimates with the causal ones before."""
    spent = {index: one.seconds for index, one in records.items()}
    stages = {index: one.stages for index, one in records.items()}
    if refined := [index for index, one in records.items() if one.refined]:
        causal = {one.index: one for one in RunReader(run.folder, refined=False).frames}
        told = run.description.get("refinement") or {}
        every = sum(one.refined for one in run.frames)
        of_all = run.refinement_stages
        again = None if of_all is None else of_all * (1 / every)
        total = again.whole * every if again else told.get("seconds")
        for index in refined:
            before = causal.get(records[index].index)
            share = total / every if isinstance(total, int | float) else spent[index]
            spent[index] = (before.seconds if before else 0.0) + share
            of_causal = before.stages if before else None
            stages[index] = of_causal + again if of_causal and again else None
    return (
        {index: seconds for index, seconds in spent.items() if math.isfinite(seconds)},
        {index: one for index, one in stages.items() if one is not None and math.isfinite(one.whole)},
    )


def _masks_in(
    folder: Path, path_of: Callable[[Path, int], Path], records: Mapping[int, FrameRecord]
) -> dict[int, MaskReference]:
    files = {index: path_of(folder, one.index) for index, one in records.items()}
    return {index: MaskFile(file) for index, file in files.items() if file.is_file()}


def _frames(truth: Truth, offset: int) -> ImageSequence:
    """The frames of the clip by the indices that the run has for them."""
    before = (truth.frames[0],) * max(-offset, 0)  # is not read
    files = (*before, *truth.frames[max(offset, 0) :])
    return ImageSequence(truth.name, files, range(len(before), len(files)))


@dataclass(frozen=True, eq=False)
class _RunPoints:
    """Follows points by the mesh and the poses of a run; see `tracking3d_bench.datasets.answers.PointTracker`.

    Attributes:
        run: The run.
        frames: How many the clip has.
        offset: See `answers_of_run`.
        images: Corrects by landmarks and images, where they are given.
    """

    run: RunReader
    frames: int
    offset: int = 0
    images: ImageSequence | None = None

    @cached_property
    def _scene(self) -> RunScene | None:
        from tracking3d.results.point_tracking import open_scene

        return None if self.images is None else open_scene(self.run, self.images)

    def __call__(self, frame: int, points: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        count = len(np.asarray(points))
        positions = np.full((self.frames, count, 2), np.nan)
        visible = np.zeros((self.frames, count), bool)
        own = frame - self.offset
        record = next((one for one in self.run.frames if one.index == own), None)
        if record is None or record.status is Status.LOST or not record.has_pose:
            return positions, visible  # where the object was not found, its points were not either
        from tracking3d.results.correspondences import track_points

        scene = self._scene
        tracks = track_points(self.run, own, points) if scene is None else scene.track(own, points)
        frames = tracks.frames + self.offset
        inside = (frames >= 0) & (frames < self.frames)
        positions[frames[inside]] = tracks.positions[inside]
        visible[frames[inside]] = tracks.visible[inside]
        return positions, visible
