"""The result of a tracking, as arrays and as a run folder that can be saved."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
import trimesh
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.export.exporting import Export, export_run
from tracking3d.export.options import ExportOptions
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.validation import validate_folder
from tracking3d.results.correspondences import PointTracks, track_points
from tracking3d.results.files import writing
from tracking3d.results.mesh_export import load_model
from tracking3d.results.overwrite import clear_run_folder
from tracking3d.results.point_tracking import RunScene, open_scene
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.stage_times import StageTimes
from tracking3d.video.source import FrameSource


class TemporaryRun:
    """A folder for a run that goes when nobody has it any more, or when the process ends.

    Attributes:
        folder: The run folder.
        about_shape: Outcome of the shape reconstruction, in a sentence; empty if it was not requested.
    """

    def __init__(self) -> None:
        self.about_shape = ""
        self.folder = Path(tempfile.mkdtemp(prefix="tracking3d-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)


class MaskSequence(Sequence[NDArray[np.bool_]]):
    """The estimates' masks in the order of the frames, each read on access; ``np.asarray`` reads all.

    Args:
        run: The run.
    """

    def __init__(self, run: RunReader) -> None:
        self._run = run

    def __len__(self) -> int:
        """The number of frames."""
        return len(self._run.frames)

    @overload
    def __getitem__(self, position: int) -> NDArray[np.bool_]: ...
    @overload
    def __getitem__(self, position: slice) -> list[NDArray[np.bool_]]: ...
    def __getitem__(self, position: int | slice) -> NDArray[np.bool_] | list[NDArray[np.bool_]]:
        """``(H, W)`` bool of one frame, by its position."""
        if isinstance(position, slice):
            return [self._run.mask(record.index) for record in self._run.frames[position]]
        return self._run.mask(self._run.frames[position].index)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """``(N, H, W)``."""
        return np.stack(list(self)).astype(dtype or np.bool_, copy=False)


class TrackingResult:
    """All estimates of a tracking and the object: what a run folder of the command line holds.

    Rows of everything are the frames that were estimated, in order of time. Lengths are in the run's own unit, see
    docs/conventions.md.

    Attributes:
        run: The run folder that it is read from; temporary, see `save`.
    """

    def __init__(
        self,
        kept: TemporaryRun,
        source: FrameSource,
        queries: NDArray[np.float64] | None = None,
        refined: bool = True,
    ) -> None:
        self._kept, self._source, self._queries = kept, source, queries
        self.run = RunReader(kept.folder, refined=refined)

    def __len__(self) -> int:
        """How many frames were estimated."""
        return len(self.frames)

    @property
    def frames(self) -> list[FrameRecord]:
        """The record of each frame."""
        return self.run.frames

    @property
    def refined(self) -> bool:
        """Whether there was a final refinement and these are its estimates."""
        return any(record.refined for record in self.frames)

    @property
    def causal(self) -> TrackingResult:
        """The estimates as they were before the final refinement."""
        return TrackingResult(self._kept, self._source, self._queries, refined=False)

    @property
    def indices(self) -> NDArray[np.int64]:
        """``(N,)`` positions of the frames in the source."""
        return np.array([record.index for record in self.frames], dtype=np.int64)

    @property
    def poses(self) -> NDArray[np.float64]:
        """``(N, 4, 4)`` ``T_cam_obj``; the last known pose if the object is lost, see `statuses`."""
        return np.array([record.T_cam_obj for record in self.frames]).reshape(-1, 4, 4)

    @property
    def masks(self) -> MaskSequence:
        """``(N, H, W)`` bool, read as they are asked for."""
        return MaskSequence(self.run)

    @property
    def statuses(self) -> tuple[Status, ...]:
        """Status of each frame: tracked, uncertain or lost."""
        return tuple(record.status for record in self.frames)

    @property
    def confidences(self) -> NDArray[np.float64]:
        """``(N,)`` in [0, 1]."""
        return np.array([record.confidence for record in self.frames], dtype=np.float64)

    @property
    def timings(self) -> tuple[StageTimes | None, ...]:
        """Seconds of each frame by stage; the refinement's own is ``run.refinement_stages``."""
        return tuple(record.stages for record in self.frames)

    @property
    def camera(self) -> Camera:
        """The camera of the full frame."""
        return self.run.camera

    @cached_property
    def model(self) -> ObjectModel:
        """The object: one textured mesh in object coordinates.

        Raises:
            InputError: If there is none, since tracking ended early.
        """
        return load_model(self.run.mesh_folder)

    @property
    def about_shape(self) -> str:
        """How much better the shape is that ``model="fine"`` made, or why the old one stays; else empty."""
        return self._kept.about_shape

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The same for trimesh."""
        return self.run.mesh()

    @cached_property
    def tracks(self) -> tuple[PointTracks, ...]:
        """The points that ``follow=`` asked for, through all frames: one set for each frame that points are asked in.

        They rest on the whole video, unlike the ``points`` of the single estimates.

        Raises:
            InputError: If a frame that points are asked in was not estimated, or the object is lost there.
        """
        if self._queries is None:
            return ()
        first = (self.run.description.get("prompt") or {}).get("first_frame", 0)
        frames = np.where(self._queries[:, 0] < 0, first, self._queries[:, 0]).astype(int)
        return tuple(
            self.track_points(int(frame), self._queries[frames == frame, 1:]) for frame in np.unique(frames)
        )

    def track_points(self, frame: int, xy: ArrayLike, *, beside_object: bool = False) -> PointTracks:
        """Track the points under some pixels of one frame through all frames.

        By mesh, poses and images; by mesh and poses if the frames can be read once only.

        Args:
            frame: Index of the frame that ``xy`` is in.
            xy: ``(N, 2)`` pixels.
            beside_object: Follow background pixels too, in the images alone; else they have no estimate.

        Raises:
            InputError: If there is no such frame or model, the object is lost in it, ``xy`` are no points, or points
                on the background are requested although the frames can be read once only.
        """
        if not self._source.repeatable:
            if beside_object:
                raise InputError(
                    "beside_object=True needs the frames a second time, and these come once only; give a file or a "
                    "list of images to track()."
                )
            return track_points(self.run, frame, xy)
        track_points(self.run, frame, xy)  # bad questions are given before the frames are read
        return self._scene.track(frame, xy, beside_object)

    @cached_property
    def _scene(self) -> RunScene:
        return open_scene(self.run, self._source)

    def save(self, folder: Path | str, *, overwrite: bool = False) -> RunReader:
        """Save everything as a run folder, which every command of the command line takes.

        Args:
            folder: The new run folder.
            overwrite: Replace a run that is there.

        Returns:
            Its reader.

        Raises:
            OutputError: If there is a run already, or the folder cannot be written.
        """
        into = validate_folder(folder)
        with writing(into):
            into.mkdir(parents=True, exist_ok=True)
        clear_run_folder(into, overwrite)
        with writing(into):
            shutil.copytree(self.run.folder, into, dirs_exist_ok=True)
        return RunReader(into, refined=self.run.refined)

    def export(
        self, to: str, out: Path | str, *, options: ExportOptions | None = None, overwrite: bool = False
    ) -> Export:
        """Write everything in the format of another tool, see `tracking3d.export_run`.

        Args:
            to: Name of the format.
            out: The file or folder to write.
            options: What else is asked.
            overwrite: Replace an existing run.

        Raises:
            InputError: If there is no such format, or nothing to write in it.
            OutputError: If it cannot be written.
        """
        if out is None:
            raise InputError("out= is None; give a path, since the run's own folder is temporary.")
        if not self.run.refined:
            options = replace(options or ExportOptions(), answers="causal")
        return export_run(self.run.folder, to, out, options=options, overwrite=overwrite)
