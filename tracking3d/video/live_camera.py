"""Frames from a connected camera: always the newest one, however slow the consumer is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count as counting
from typing import cast

import cv2

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.video.latest_frames import newest
from tracking3d.video.opencv_log import silent_opencv
from tracking3d.video.selection import EVERY_FRAME
from tracking3d.video.source import Intrinsics, check_frames


@dataclass(frozen=True, eq=False)
class LiveCamera:
    """A camera by its OpenCV index; it goes on until the selection ends or the camera stops.

    Frames that come while the one before is still worked on are dropped, see `tracking3d.video.latest_frames`.

    See `tracking3d.video.source.FrameSource` for the attributes. Times are seconds since the first frame.
    """

    number: int
    selection: range
    fps: float | None
    count: int | None = None
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    repeatable: bool = False
    live: bool = True

    @classmethod
    def open(cls, number: int, selection: range = EVERY_FRAME) -> LiveCamera:
        """Check that the camera is there and ask it for its frame rate.

        Raises:
            InputError: If the camera cannot be opened.
        """
        camera = _open(number)
        rate = camera.get(cv2.CAP_PROP_FPS)
        camera.release()
        return cls(number, selection, rate / selection.step if rate > 0 else None)

    @property
    def name(self) -> str:
        """``"camera 0"``."""
        return f"camera {self.number}"

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Open the camera and give the newest frame whenever one is asked for, those dropped as `SkippedFrame`."""
        return check_frames(newest(self._frames()), self.name)

    def _frames(self) -> Iterator[Frame]:
        camera = _open(self.number)
        start = None
        try:
            for index in counting():
                if index >= self.selection.stop or not camera.grab():
                    return
                now = time.monotonic()
                start = now if start is None else start
                if index in self.selection:
                    decoded, image = camera.retrieve()
                    if not decoded:
                        return
                    rgb = cast(Image, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
                    yield Frame(index, rgb, now - start, f"frame {index}")
        finally:
            camera.release()


def _open(number: int) -> cv2.VideoCapture:
    with silent_opencv():
        camera = cv2.VideoCapture(number)
    if not camera.isOpened():
        raise InputError(
            f"Camera {number} cannot be opened; check that it is connected and not in use, or give an "
            "existing file or folder."
        )
    return camera
