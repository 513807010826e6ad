"""Writing a video that plays in browsers: H.264 in MP4."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from av.video.stream import VideoStream

from tracking3d.errors import OutputError
from tracking3d.frames import Image
from tracking3d.video.video_decoding import codec_threads

ENCODERS = ("libx264", "libopenh264", "h264_videotoolbox", "h264_mf", "mpeg4")
"""Encoders by preference: x264, other H.264 encoders, and MPEG-4 part 2, which every FFmpeg has."""

_OPTIONS = {"libx264": {"crf": "20", "preset": "superfast", "tune": "zerolatency"}, "mpeg4": {"qscale": "3"}}

_FRAGMENTED = {"movflags": "+frag_every_frame+empty_moov+default_base_moof", "flush_packets": "1"}
"""Every frame is its own fragment, so that the file plays while it grows, and a killed process loses only the last one.
"""
_SEEKABLE = {"movflags": "+faststart"}
"""One index of all frames before the first, as players and browsers want it that jump to any of them."""


class VideoWriter:
    """Writes RGB frames of one size to an MP4 file, one at a time.

    Use it in a ``with`` statement: however that ends, by an exception or Ctrl-C too, the file is finished and
    plays with the frames written so far. Without a frame there is no file. While it grows it can be watched already;
    at the end it gets an index of all frames, so that players can jump to each. Odd sizes are padded by one row or
    column, which H.264's halved colour planes need.
    """

    def __init__(self, path: str | Path, fps: float, size: tuple[int, int]) -> None:
        """Create the file; an existing one is replaced.

        Args:
            path: The file, whatever its suffix, becomes an MP4.
            fps: Frames per second, above 0.
            size: ``(height, width)`` of the frames in pixels.

        Raises:
            OutputError: If the file cannot be created.
        """
        if not 0 < fps < float("inf"):
            raise ValueError(f"fps is {fps}, not a positive number")
        self.path = Path(path)
        self.size = size
        self._frames = 0
        self._closed = False
        self._failed = False
        self._file: BinaryIO | None = None
        self._reformatter = VideoReformatter()  # one for all frames: to set it up takes longer than to use it
        with self._output_errors():
            # Python's file: FFmpeg forgets a failed write of a fragment, Python does not.
            self._file = self.path.open("wb")
            self._container = av.open(self._file, "w", format="mp4", options=_FRAGMENTED)
            rate = max(Fraction(fps).limit_denominator(1001), Fraction(1, 1001))
            self._stream = self._add_stream(rate)
            # The header now: FFmpeg crashes if it is asked for it again after it could not be written.
            self._container.start_encoding()

    def _add_stream(self, rate: Fraction) -> VideoStream:
        encoder = next(name for name in ENCODERS if name in av.codecs_available)
        stream = self._container.add_stream(encoder, rate=rate, options=_OPTIONS.get(encoder, {}))
        assert isinstance(stream, VideoStream)
        height, width = self.size
        stream.height, stream.width = height + height % 2, width + width % 2
        stream.pix_fmt = "yuv420p"
        stream.codec_context.thread_count = codec_threads()
        # FFmpeg's own assumption if an encoder cannot store it, such as mpeg4; H.264 does, for browsers.
        stream.codec_context.colorspace = Colorspace.ITU601
        stream.codec_context.color_range = ColorRange.MPEG
        return stream

    def write(self, image: Image) -> None:
        """Append a frame.

        Args:
            image: ``(H, W, 3)`` uint8 RGB of the writer's size.

        Raises:
            OutputError: If the disk is full or the file has become unwritable.
        """
        if image.shape != (*self.size, 3) or image.dtype != np.uint8:
            raise ValueError(f"image is {image.shape} {image.dtype}, not {(*self.size, 3)} uint8")
        height, width = self.size
        padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        frame = self._reformatter.reformat(
            av.VideoFrame.from_ndarray(padded, format="rgb24"),
            format="yuv420p",
            dst_colorspace=Colorspace.ITU601,
            dst_color_range=ColorRange.MPEG,
        )
        frame.pts = self._frames
        with self._output_errors():
            self._container.mux(self._stream.encode(frame))
            assert self._file is not None  # opened in the constructor
            self._file.flush()
        self._frames += 1

    def close(self) -> None:
        """Finish the file. Closing again does nothing.

        Raises:
            OutputError: If the rest cannot be written.
        """
        if self._closed:
            return
        self._closed = True
        with self._output_errors():
            try:
                if self._frames and not self._failed:
                    self._container.mux(self._stream.encode(None))
            finally:
                try:
                    self._container.close()
                finally:
                    if self._file is not None:
                        self._file.close()
        if not self._frames and self.path.is_file():
            self.path.unlink()
        elif not self._failed:
            _add_index(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except OutputError:
            if error is None:
                raise  # otherwise the first failure is the one to hear of

    @contextmanager
    def _output_errors(self) -> Iterator[None]:
        try:
            yield
        except (FFmpegError, OSError) as error:
            self._failed = True
            if self._file is not None:
                with suppress(OSError):
                    self._file.close()
            reason = getattr(error, "strerror", None) or error
            raise OutputError(f"{self.path} cannot be written: {reason}.") from error


def _add_index(path: Path) -> None:
    """Copy a video of fragments into one with an index, without encoding it again; if that fails, it stays as it is."""
    partial = path.with_name(f".{path.name}.part")
    try:
        with (
            av.open(str(path)) as fragments,
            av.open(str(partial), "w", format="mp4", options=_SEEKABLE) as whole,
        ):
            [stream] = fragments.streams.video
            copy = whole.add_stream_from_template(stream)
            for packet in fragments.demux(stream):
                if packet.dts is not None:  # the last one only says that there are no more
                    packet.stream = copy
                    whole.mux(packet)
        partial.replace(path)
    except (FFmpegError, OSError):  # a full disk: the fragments play too
        pass
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
