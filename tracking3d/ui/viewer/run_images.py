"""The frames of a run's video, as far as they are still available."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.results import layout
from tracking3d.results.run_reader import places_of
from tracking3d.video.any_frame import MOST_KEPT, FrameImages, VideoPictures, frame_images
from tracking3d.video.opening import open_source
from tracking3d.video.source import FrameSource, Intrinsics, source_notes
from tracking3d.video.video_file import VideoFile


def images_of_run(source: str, folder: Path) -> FrameImages | None:
    """The frames that a run was made from; None if they are no longer there.

    Args:
        source: What ``run.json`` calls the source; relative to where the run was started, which is tried from the
            present folder and from those above the run's.
        folder: The run folder.
    """
    for place in places_of(source, folder):
        if not source.isdigit() and (place.exists() or "*" in source):
            try:
                return frame_images(open_source(str(place)))
            except InputError:
                continue
    return None


class LatestImages:
    """Passes the frames of a source on, and keeps the latest ones to look at: a camera gives each only once.

    See `tracking3d.video.source.FrameSource` for the other attributes.

    Args:
        source: The source.
        most: Bytes of frames that are kept.
    """

    def __init__(self, source: FrameSource, most: int = MOST_KEPT) -> None:
        self.source, self._most = source, most
        self._kept: OrderedDict[int, Image] = OrderedDict()
        self._lock = threading.Lock()

    name = property(lambda self: self.source.name)
    count = property(lambda self: self.source.count)
    fps = property(lambda self: self.source.fps)
    repeatable = property(lambda self: self.source.repeatable)
    notes = property(lambda self: source_notes(self.source))
    intrinsics_origin = property(lambda self: self.source.intrinsics_origin)

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The source's."""
        return self.source.intrinsics

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """The frames of the source."""
        for frame in self.source:
            if isinstance(frame, Frame):
                self._keep(frame)
            yield frame

    def image(self, index: int) -> Image | None:
        """A frame of those that are kept ``(H, W, 3)``, or None."""
        with self._lock:
            return self._kept.get(index)

    def _keep(self, frame: Frame) -> None:
        with self._lock:
            self._kept[frame.index] = frame.image
            while len(self._kept) > max(1, self._most // max(frame.image.nbytes, 1)):
                self._kept.popitem(last=False)


class OverlayPictures:
    """The frames out of a run's own overlay video, if those that it was made from are gone.

    Args:
        folder: The run folder.
        indices: Indices of the frames that it shows, in order.
        height: Height of a frame; the status bar below it is cut off.

    Raises:
        InputError: If the run has no such video.
    """

    def __init__(self, folder: Path, indices: list[int], height: int, width: int) -> None:
        path = folder / layout.OVERLAY
        self._pictures = VideoPictures(VideoFile.open(str(path), path))
        self._place = {index: place for place, index in enumerate(indices)}
        self._height, self._width = height, width

    def image(self, index: int) -> Image | None:
        """The frame with the outlines that the run drew into it, or None."""
        if index not in self._place or (picture := self._pictures.image(self._place[index])) is None:
            return None
        return picture[: round(self._height * picture.shape[1] / self._width)]
