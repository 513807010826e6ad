"""Random access to the frames of a video, decoded on demand."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Protocol

import av
from av.error import FFmpegError

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.video.image_file import read_image
from tracking3d.video.image_sequence import ImageSequence
from tracking3d.video.picture_conversion import PictureConverter
from tracking3d.video.source import EVERY_FRAME, FrameSource
from tracking3d.video.video_file import VideoFile, video_stream

MOST_KEPT = 128 * 2**20
"""Size in bytes of the cache of decoded frames."""
_INDEXED = frozenset({"mp4", "matroska"})
"""Containers that give the display time of every packet and mark keyframes."""


class FrameImages(Protocol):
    """Gives the picture of a frame by its index."""

    def image(self, index: int) -> Image | None:
        """``(H, W, 3)``, or None if there is none."""
        ...


def frame_images(source: FrameSource) -> KeptImages:
    """Access to any frame of a source.

    Raises:
        InputError: If it is one that cannot be read again, such as a camera.
    """
    if isinstance(source, ImageSequence):
        return KeptImages(ImageFiles(source).image, len(source.files))
    if isinstance(source, VideoFile):
        pictures = VideoPictures(source)
        return KeptImages(pictures.image, pictures.count or source.count)
    raise InputError(f"{source.name} cannot be read again; give a video file or a folder of images.")


class KeptImages:
    """Keeps what was decoded lately, within `MOST_KEPT`; for several threads.

    Args:
        decode: Gives the picture of a frame, or None.
        count: Number of all frames of the source, if known.
    """

    def __init__(self, decode: Callable[[int], Image | None], count: int | None) -> None:
        self._decode, self.count = decode, count
        self._kept: OrderedDict[int, Image | None] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def image(self, index: int) -> Image | None:
        """The frame ``(H, W, 3)``, or None if there is none."""
        with self._lock:
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
            image = self._decode(index)
            self._kept[index] = image
            self._bytes += image.nbytes if image is not None else 0
            while self._bytes > MOST_KEPT and len(self._kept) > 1:
                _, gone = self._kept.popitem(last=False)
                self._bytes -= gone.nbytes if gone is not None else 0
            return image


class ImageFiles:
    """The images of a sequence, each a file.

    Args:
        sequence: Which files.
    """

    def __init__(self, sequence: ImageSequence) -> None:
        self._files = sequence.files

    def image(self, index: int) -> Image | None:
        """The frame ``(H, W, 3)``, or None if it cannot be read."""
        try:
            return read_image(self._files[index]) if 0 <= index < len(self._files) else None
        except InputError:
            return None


class VideoPictures:
    """The pictures of a video file, found by seeking.

    The header's index tells the time of every picture; from the picture before it that needs no other, everything is
    decoded up to the one that is asked for. Pictures asked for one after another are decoded once. Containers whose
    index is not to be relied on are read from their beginning, or on from where they are.

    Args:
        video: The file.
    """

    def __init__(self, video: VideoFile) -> None:
        self._video = replace(video, selection=EVERY_FRAME)
        self._container = video.container()
        self._convert = PictureConverter()
        stream = video_stream(self._container)
        assert stream is not None  # VideoFile.open has made sure
        self._stream = stream
        self._times = self._presentation_times()
        self._place = {time: index for index, time in enumerate(self._times)}
        self._running: Iterator[av.VideoFrame] | None = None
        self._reading: Iterator[Frame | SkippedFrame] = iter(())
        self._next = 0

    @property
    def count(self) -> int:
        """Number of pictures; 0 if the file has no time stamps."""
        return len(self._times)

    def image(self, index: int) -> Image | None:
        """The frame ``(H, W, 3)``, or None if it cannot be decoded."""
        if not self._times:
            return self._counted(index)
        if not 0 <= index < len(self._times):
            return None
        try:
            return self._sought(index)
        except FFmpegError:  # it cannot be sought
            self._running = None
            return None

    def _presentation_times(self) -> list[int]:
        """Time stamps of all pictures in display order; none if they are unreliable."""
        if self._video.interlaced or not _INDEXED & set(self._container.format.name.split(",")):
            return []  # a picture that is made of its neighbours' lines is not found alone
        try:
            packets = [packet for packet in self._container.demux(self._stream) if packet.size]
        except FFmpegError:
            return []
        times = [packet.pts for packet in packets if packet.pts is not None and not packet.is_discard]
        return sorted(times) if len(set(times)) == len(packets) else []

    def _sought(self, index: int) -> Image | None:
        near = self._running is not None and 0 <= index - self._next < 16
        if not near:
            self._container.seek(self._times[index], stream=self._stream, backward=True)
            self._running = self._pictures()
        for picture in self._running or ():
            at = self._place.get(picture.pts) if picture.pts is not None else None
            if at is None:
                continue
            self._next = at + 1
            if at == index:
                return self._convert_frame(picture)
            if at > index:
                break
        self._running = None
        return None

    def _convert_frame(self, picture: av.VideoFrame) -> Image | None:
        try:
            return self._convert(picture)
        except ValueError:
            return None

    def _pictures(self) -> Iterator[av.VideoFrame]:
        """The decodable pictures from the present position."""
        for packet in self._container.demux(self._stream):
            with suppress(FFmpegError):
                yield from (picture for picture in packet.decode() if isinstance(picture, av.VideoFrame))

    def _counted(self, index: int) -> Image | None:
        """The frame by reading on to it, or from the beginning if it lies before the present position."""
        if index < self._next:
            self._reading, self._next = iter(()), 0
        if not self._next:
            self._reading = iter(self._video)
        for frame in self._reading:
            self._next = frame.index + 1
            if frame.index >= index:
                return frame.image if isinstance(frame, Frame) and frame.index == index else None
        return None
