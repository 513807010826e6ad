"""Frames from a video file of any codec that FFmpeg knows (through PyAV)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video.picture_conversion import PictureConverter, said_of
from tracking3d.video.source import EVERY_FRAME, Intrinsics, check_frames, within
from tracking3d.video.video_decoding import decode_pictures, deinterlace


@dataclass(frozen=True, eq=False)
class VideoFile:
    """A video file, decoded frame by frame.

    See `tracking3d.video.source.FrameSource` for the other attributes. Frames are turned upright as the file asks
    for, deinterlaced, and tone-mapped to sRGB; their times are the file's own, so that a variable frame rate is kept.
    """

    name: str
    path: Path  # where it lies
    selection: range
    count: int | None
    fps: float | None
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    repeatable: bool = True
    interlaced: bool = False  # whether its first picture is interlaced
    notes: tuple[str, ...] = ()  # what was done to the pictures, in clauses
    # whether the header states how many frames there are; else count comes from duration and rate
    counted: bool = False
    distinct: frozenset[int] | None = None  # see `tracking3d.video.source.check_frames`

    @property
    def indices(self) -> range | None:
        """Indices of the selected frames, if the header states how many frames there are or the selection ends."""
        if self.counted and self.count is not None:
            return self.selection[: self.count]
        return None if self.selection.stop == EVERY_FRAME.stop else self.selection

    @classmethod
    def open(cls, name: str, path: Path, selection: range = EVERY_FRAME) -> VideoFile:
        """Read the file's header.

        Args:
            name: What messages call the video.
            path: The file.
            selection: Wanted frame indices.

        Raises:
            InputError: If it is no video, or truncated beyond use.
        """
        with open_container(name, path) as container:
            return describe_video(container, name, path, selection)

    def container(self) -> InputContainer:
        """The file, open at its beginning.

        Raises:
            InputError: If it cannot be opened.
        """
        return open_container(self.name, self.path)

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Decode the selected frames; those that cannot be decoded are given as skipped."""
        return check_frames(self._frames(), self.name, self.distinct)

    def _frames(self) -> Iterator[Frame | SkippedFrame]:
        with self.container() as container:
            stream = video_stream(container)
            assert stream is not None
            start, convert = stream.start_time, PictureConverter()
            for index, picture in enumerate(deinterlace(decode_pictures(container, stream))):
                seconds = None
                if isinstance(picture, av.VideoFrame) and picture.pts is not None and stream.time_base:
                    start = picture.pts if start is None else min(start, picture.pts)
                    seconds = float((picture.pts - start) * stream.time_base)
                if index not in self.selection:
                    continue
                if isinstance(picture, str):
                    yield SkippedFrame(index, f"frame {index}: {picture}")
                else:
                    yield frame_of(index, picture, seconds, convert)
                if index + 1 >= self.selection.stop:
                    return


def describe_video(container: InputContainer, name: str, path: Path, selection: range) -> VideoFile:
    """What an open file's header and first picture tell; see `VideoFile.open`."""
    if container.format.name in ("tty", "image2") or container.format.name.endswith("_pipe"):
        raise InputError(f"{name} is not a video; give a video file or a folder of images.")
    stream = video_stream(container)
    if stream is None:
        raise InputError(f"{name} contains no video; give a file with a video stream.")
    if stream.codec_context is None:
        raise InputError(f"{name} uses an unsupported video codec; convert it to H.264 first.")
    frames = _announced_frames(container, stream)
    rate = stream.average_rate or stream.guessed_rate
    first = _first_picture(container, stream)
    return VideoFile(
        name,
        path,
        selection,
        len(within(selection, frames)) if frames else None,
        float(rate) / selection.step if rate else None,
        interlaced=first is not None and first.interlaced_frame,
        notes=() if first is None else said_of(first),
        counted=stream.frames > 0,
    )


def open_container(name: str, path: Path) -> InputContainer:
    """A file on disk, open at its beginning.

    Raises:
        InputError: If it is no video.
    """
    try:
        # "file:" keeps FFmpeg from taking a colon in the name for a protocol.
        return av.open(f"file:{path}", metadata_errors="ignore")
    except (FFmpegError, OSError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"{name} cannot be read as a video ({reason}); check that the file is complete."
        ) from error


def video_stream(container: InputContainer) -> VideoStream | None:
    """The first video stream that is not the cover picture of a song."""
    cover = av.stream.Disposition.attached_pic
    return next((stream for stream in container.streams.video if not stream.disposition & cover), None)


def _announced_frames(container: InputContainer, stream: VideoStream) -> int | None:
    """How many frames the header tells of, or the rate makes likely; None if neither is known."""
    if stream.frames:
        return stream.frames
    if stream.duration and stream.time_base:
        duration = float(stream.duration * stream.time_base)
    else:
        duration = (container.duration or 0) / av.time_base
    return round(duration * stream.average_rate) if duration > 0 and stream.average_rate else None


def _first_picture(container: InputContainer, stream: VideoStream) -> av.VideoFrame | None:
    """The first picture that can be decoded, if one of the first few can."""
    with suppress(FFmpegError):
        for picture in islice(container.decode(stream), 1):
            return picture if isinstance(picture, av.VideoFrame) else None
    return None


def frame_of(
    index: int, picture: av.VideoFrame, seconds: float | None, convert: PictureConverter
) -> Frame | SkippedFrame:
    """The frame of a decoded picture, or why there is none."""
    name = f"frame {index}"
    try:
        return Frame(index, convert(picture), seconds, name)
    except ValueError as error:
        return SkippedFrame(index, f"{name}: {error}")
