"""The data of a run for an export: poses, masks, mesh and images, in metres if the scale is known."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, argument
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.export.options import ExportOptions
from tracking3d.frames import Frame, SkippedFrame, pixels
from tracking3d.geometry.camera import Camera
from tracking3d.results.checkpoint.progress import checksum
from tracking3d.results.layout import METRE, runs_in
from tracking3d.results.mesh_export import cut_unseen, load_model
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, places_of
from tracking3d.results.run_unit import metres_per_unit, scale_model, scale_pose
from tracking3d.runtime.progress import report_each
from tracking3d.video import open_source
from tracking3d.video.source import parse_selection

FRAMES_PER_SECOND = 30.0
"""Assumed by formats that require a frame rate if it is unknown."""
_SOURCE = argument("source=", "--source")


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """A frame whose pose can be relied on."""

    index: int  # its index in the source
    seconds: float | None  # time since the source's start, None if not known
    T_cam_obj: NDArray[np.float64]  # (4, 4) float64, with the translation in the unit of the export
    camera: Camera  # the camera that the pose is of
    record: FrameRecord  # everything else that the run knows of it; lengths there are in the run's unit

    def T_through(self, camera: Camera) -> NDArray[np.float64]:
        """The pose for a format that has one lens for all frames, ``camera``.

        If the frame was solved with another focal length, the object is moved along the axis until it is seen at
        its place and in its size again; what remains is the perspective within the object.
        """
        if (self.camera.fx, self.camera.cx, self.camera.cy) == (camera.fx, camera.cx, camera.cy):
            return self.T_cam_obj
        x, y, z = self.T_cam_obj[:3, 3]
        pixel = np.array(
            [self.camera.fx * x / z + self.camera.cx, self.camera.fy * y / z + self.camera.cy, 1.0]
        )
        T = self.T_cam_obj.copy()
        T[:3, 3] = z * camera.fx / self.camera.fx * np.linalg.solve(camera.K, pixel)
        return T


class ExportedRun:
    """A run, as its export was asked for.

    Args:
        reader: The run with the estimates that were asked for.
        options: What was asked.
    """

    def __init__(self, reader: RunReader, options: ExportOptions) -> None:
        self.reader = reader
        self.options = options

    @property
    def name(self) -> str:
        """The run folder's name, of letters, digits and hyphens alone."""
        return re.sub("[^A-Za-z0-9]+", "-", self.reader.folder.resolve().name).strip("-") or "run"

    @property
    def title(self) -> str:
        """The run folder's name; of one of several objects with the name of the folder that holds them."""
        folder = self.reader.folder.resolve()
        several = folder in runs_in(folder.parent) and len(runs_in(folder.parent)) > 1
        return f"{folder.parent.name}_{folder.name}" if several else folder.name or "run"

    @property
    def camera(self) -> Camera:
        """The camera of the full frame."""
        return self.reader.camera

    @cached_property
    def records(self) -> dict[int, FrameRecord]:
        """The estimates by frame index, in order."""
        return {record.index: record for record in self.reader.frames}

    @property
    def free_axis(self) -> tuple[float, float, float] | None:
        """An axis about which the rotation of poses is not known, as the last frame has it; None without one."""
        return next((one.free_axis for one in reversed(self.records.values()) if one.free_axis), None)

    @cached_property
    def span(self) -> range:
        """The frames from the first to the last estimate, those that were skipped in between too.

        Raises:
            InputError: If the run has no estimate.
        """
        if not self.records:
            raise InputError(
                f"The run {self.reader.folder} has no frames yet, so there is nothing to export."
            )
        step = parse_selection(self.reader.description.get("selection")).step
        return range(min(self.records), max(self.records) + 1, step)

    @cached_property
    def poses(self) -> list[PosedFrame]:
        """The frames that have a pose; those that are lost have none.

        Raises:
            InputError: If there is no such frame.
        """
        posed = [
            PosedFrame(
                n, self.seconds(n), scale_pose(one.T_cam_obj, self.scale), self.reader.camera_of(one), one
            )
            for n, one in self.records.items()
            if one.status is not Status.LOST and one.has_pose
        ]
        if not posed:
            raise InputError(
                f"The run {self.reader.folder} has no frame with a pose, so there is nothing to export."
            )
        return posed

    @property
    def without_pose(self) -> list[int]:
        """Frames of `span` that have no pose, since they are lost or were skipped."""
        posed = {one.index for one in self.poses}
        return [index for index in self.span if index not in posed]

    @property
    def known_fps(self) -> float | None:
        """Frames of the source per second, counted by index; None if unknown."""
        if self.options.fps is not None:
            return self.options.fps
        fps = self.reader.description.get("fps")
        if not isinstance(fps, int | float) or not 0 < fps < np.inf:
            return None
        # A run on every second frame has half the rate, and its indices are still the source's.
        return float(fps) * parse_selection(self.reader.description.get("selection")).step

    @property
    def fps(self) -> float:
        """Frames of the source per second; `FRAMES_PER_SECOND` if unknown."""
        return self.known_fps or FRAMES_PER_SECOND

    def seconds(self, index: int) -> float | None:
        """Time of a frame since the start of the source; None if unknown."""
        record = self.records.get(index)
        if self.options.fps is None and record is not None and record.time is not None:
            return record.time
        return None if self.known_fps is None else index / self.known_fps

    @cached_property
    def scale(self) -> float:
        """Units of the export per unit of the run.

        Raises:
            InputError: If the run has no mesh to measure.
        """
        if self.options.object_size is None:
            return 1.0
        return metres_per_unit(load_model(self.reader.mesh_folder), self.options.object_size)

    @property
    def unit(self) -> str:
        """The unit of lengths, in words."""
        return METRE if self.options.object_size is not None else self.reader.unit

    @cached_property
    def model(self) -> ObjectModel:
        """The mesh in object coordinates, in the unit of the export; with the option ``cut`` of what was seen alone.

        Raises:
            InputError: If the run has none, or no frame has shown any of it.
        """
        model = scale_model(load_model(self.reader.mesh_folder), self.scale)
        if self.options.unseen == "close":
            return model
        model = cut_unseen(model)
        if not len(model.faces):
            raise InputError(
                f"No frame of {self.reader.folder} has shown the surface, so that nothing would be left of it; "
                "export it whole."
            )
        return model

    def mask(self, index: int) -> NDArray[np.bool_]:
        """``(H, W)``: the estimated mask of a frame of `span`; empty if the frame was skipped."""
        if index not in self.records:
            return np.zeros((self.camera.height, self.camera.width), bool)
        return self.reader.pinhole_mask(index) if self.options.undistorted else self.reader.mask(index)

    def pinhole_mask(self, index: int) -> NDArray[np.bool_]:
        """The same as the camera of the poses sees it, without the distortion of a lens."""
        if index not in self.records:
            return np.zeros((self.camera.height, self.camera.width), bool)
        return self.reader.pinhole_mask(index)

    @cached_property
    def with_probability(self) -> list[int]:
        """The frames whose estimate has a probability in every pixel."""
        return [index for index in self.records if self.reader.probability(index) is not None]

    def probability(self, index: int) -> NDArray[np.float32] | None:
        """``(H, W)``: the object's in every pixel of a frame's estimate, or None if it has none."""
        found = self.reader.probability(index)
        if found is None or not self.options.undistorted:
            return found
        return self.camera.probability_to_pinhole(found)

    def pinhole_pictures(self) -> Iterator[Frame]:
        """The pictures as the camera of the poses sees them, without the distortion of a lens; see `pictures`."""
        for frame in self._read_pictures():
            yield replace(frame, image=self.camera.undistort(frame.image))

    def pictures(self) -> Iterator[Frame]:
        """The pictures of all frames that have an estimate, read from the source once more.

        Raises:
            InputError: If the source is not there any more, or is another one.
        """
        yield from self.pinhole_pictures() if self.options.undistorted else self._read_pictures()

    def _read_pictures(self) -> Iterator[Frame]:
        images = _read_selected_images(self.reader, self.options.source, self.records)
        return report_each("exporting frames", images, len(self.records))


def _read_selected_images(run: RunReader, source: str | None, wanted: Container[int]) -> Iterator[Frame]:
    """The pictures of the ``wanted`` frames, in order, from the video where the run found it if ``source`` is None."""
    name = source if source is not None else run.description.get("source")
    if not isinstance(name, str) or name.isdigit():
        raise InputError(f"The video of the run {run.folder} cannot be read again; give it as {_SOURCE}.")
    places = places_of(name, run.folder) if source is None else []
    name = next((str(place) for place in places if place.exists()), name)
    try:
        opened = open_source(name, run.description.get("selection"))
    except InputError as error:
        raise InputError(
            f"The images of the run {run.folder} cannot be read: {str(error).rstrip('.')}; give the present "
            f"path of its video as {_SOURCE}."
        ) from error
    first = (run.description.get("prompt") or {}).get("first_image_crc")
    size = run.camera.height, run.camera.width
    begun = False
    for frame in opened:
        if isinstance(frame, SkippedFrame) or frame.index not in wanted:
            continue
        if frame.size != size:
            raise InputError(
                f"Frame {frame.index} of {name} has {pixels(frame.size)} pixels, but frames of the run "
                f"{run.folder} have {pixels(size)}; give the video of the run as {_SOURCE}."
            )
        if not begun and first is not None and checksum(frame.image) != first:
            raise InputError(
                f"{name} is not the video of the run {run.folder}: the image of frame {frame.index} differs; "
                f"give the right video as {_SOURCE}."
            )
        begun = True
        yield frame
    if not begun:
        raise InputError(
            f"{name} has no frame of the run {run.folder}; give the video of the run as {_SOURCE}."
        )
