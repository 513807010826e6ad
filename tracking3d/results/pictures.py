"""Visualizations of a run: the overlay video and the crops of the contact sheet, drawn frame by frame."""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame, Image
from tracking3d.geometry.camera import Camera
from tracking3d.results.contact_sheet import CROPS, Thumbnails, draw_contact_sheet
from tracking3d.results.overlay import ObjectAxes, OverlaySize, draw_overlay
from tracking3d.results.records import FrameRecord
from tracking3d.video.writer import VideoWriter


class Pictures:
    """The pictures of one pass over the frames; the video's file is made with the first of them.

    Args:
        video: The file of the overlay video.
        camera: The camera of the full frame.
        fps: Speed of the video.
    """

    def __init__(self, video: Path, camera: Camera, fps: float) -> None:
        self._file, self.camera, self._fps = video, camera, fps
        self._video: VideoWriter | None = None
        self._axes: ObjectAxes | None = None
        self._thumbnails = Thumbnails()

    def add(self, frame: Frame, estimate: FrameEstimate, record: FrameRecord) -> None:
        """Draw the next frame while its image is there.

        Raises:
            OutputError: If the video cannot be written.
        """
        if self._axes is None and estimate.status is Status.TRACKED:
            self._axes = ObjectAxes.of(estimate, estimate.camera or self.camera)
        size = OverlaySize.of(self.camera)
        overlay = draw_overlay(frame, estimate, record, estimate.camera or self.camera, self._axes)
        self._thumbnails.add(overlay[: size.picture], size.scale, estimate)
        if self._video is None:
            self._video = VideoWriter(self._file, self._fps, (size.height, size.width))
        self._video.write(overlay)

    def add_kept(
        self,
        frame: Frame,
        record: FrameRecord,
        mask: NDArray[np.bool_] | None,
        initial: NDArray[np.bool_] | None,
    ) -> None:
        """Draw the next frame from its saved estimate.

        Args:
            frame: The frame.
            record: Its estimate.
            mask: ``(H, W)`` the estimated mask, and the initial one; None if there is none.
            initial: See ``mask``.

        Raises:
            OutputError: If the video cannot be written.
        """
        found = np.zeros(frame.size, dtype=np.bool_) if mask is None else mask
        estimate = kept_estimate(record, found, initial, self.camera)
        self.add(frame, estimate, record)

    @property
    def any(self) -> bool:
        """Whether a frame was drawn."""
        return bool(self._thumbnails.kept)

    def close(self) -> None:
        """Finish the video.

        Raises:
            OutputError: If the rest of it cannot be written.
        """
        if self._video is not None:
            self._video.close()

    def contact_sheet(
        self, model: ObjectModel | None, run: dict[str, Any], replaced: Set[int] = frozenset()
    ) -> Image | None:
        """The contact sheet, ``(H, W, 3)``; None before the first frame.

        Args:
            model: The object; None leaves texture and mesh out.
            run: ``run.json`` of the run, as it is at the end.
            replaced: Frames that were re-estimated after they were drawn.
        """
        thumbnails = self._thumbnails.spread(CROPS)
        return draw_contact_sheet(thumbnails, model, run, replaced) if thumbnails else None


def kept_estimate(
    record: FrameRecord, mask: NDArray[np.bool_], initial: NDArray[np.bool_] | None, camera: Camera
) -> FrameEstimate:
    """A saved estimate, as far as it is drawn.

    Args:
        record: The estimate.
        mask: ``(H, W)`` the estimated mask.
        initial: ``(H, W)`` the initial mask; None if there is none.
        camera: The camera of the run.
    """
    return FrameEstimate(
        index=record.index,
        time=record.time,
        T_cam_obj=record.T_cam_obj,
        mask=mask,
        initial_mask=initial,
        status=record.status,
        reason=record.reason,
        confidence=record.confidence,
        keyframe=record.keyframe,
        camera=record.through(camera),
    )
