"""Decoding a video stream so that every picture keeps its index, even if some cannot be decoded."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from fractions import Fraction

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.filter import Graph
from av.video.stream import VideoStream

# These decoders leave out a picture whose references are lost, and say nothing.
_SILENT_CODECS = ("h264", "hevc")


def decode_pictures(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame | str]:
    """All pictures of a stream in the order they are shown.

    Errors come in decoding order, pictures in presentation order, and some pictures are missing without an
    error. So each packet waits by its presentation time until a picture with that time arrives; packets that a later
    picture overtakes were not decoded.

    Args:
        container: The open file, at its start.
        stream: One of its video streams.

    Yields:
        Pictures, and in the place of each that cannot be decoded the reason, in words. If the file ends
        before the time that its header announces, one more reason says so.
    """
    stream.thread_type = "SLICE"  # with threads by frame, errors would come with later packets
    stream.codec_context.thread_count = codec_threads()
    silent = stream.codec_context.name in _SILENT_CODECS
    waiting: dict[int, str] = {}
    latest = -math.inf
    packets, end = 0, 0
    for packet in _packets(container, stream):
        reason = ""
        try:
            pictures = stream.codec_context.decode(packet)
        except FFmpegError as error:
            pictures, reason = [], f"it cannot be decoded: {error.strerror}"
        if packet is not None:
            packets += 1
            if packet.pts is not None:
                end = max(end, packet.pts + (packet.duration or 0))
            if reason and packet.pts is None:
                yield reason
            elif packet.pts is not None and (reason or (silent and not packet.is_discard)):
                waiting[packet.pts] = reason or "it cannot be decoded, or refers to a frame that cannot"
        for picture in pictures:
            if picture.interlaced_frame:  # a second field may have a packet of its own, which is no picture
                silent = False
                waiting.clear()
            if picture.pts is not None:
                if picture.pts < latest:  # the clock starts again, as in files put end to end
                    latest = -math.inf
                yield from _take(waiting, latest, picture.pts)
                waiting.pop(picture.pts, None)
                latest = picture.pts
            yield "its data is damaged" if picture.is_corrupt else picture
    yield from _take(waiting)
    if _breaks_off(stream, packets, end):
        yield f"the video ends after {packets} of {stream.frames} frames; it may be truncated"


def _packets(container: InputContainer, stream: VideoStream) -> Iterator[av.Packet | None]:
    """The stream's packets, and None at the end: the decoder is to give what it still holds."""
    with suppress(FFmpegError):  # a file that breaks off has given what it has
        for packet in container.demux(stream):
            if packet.size:
                yield packet
    yield None


def _take(waiting: dict[int, str], after: float = -math.inf, before: float = math.inf) -> list[str]:
    return [waiting.pop(pts) for pts in sorted(waiting) if after < pts < before]


def _breaks_off(stream: VideoStream, packets: int, end: int) -> bool:
    """Whether frames *and* time are missing; an edit list alone makes fewer frames."""
    if not (stream.duration and 0 < packets < stream.frames):
        return False
    return end - (stream.start_time or 0) < stream.duration * (1 - 1.5 / stream.frames)


VARIABLE = "OMP_NUM_THREADS"
"""Environment variable with the number of threads of libraries in a process."""


def codec_threads() -> int:
    """What the environment variable allows; 0, with which FFmpeg takes a thread for every core, without it."""
    given = os.environ.get(VARIABLE, "")
    return int(given) if given.isdecimal() and int(given) > 0 else 0


FILTER = "bwdif"
"""FFmpeg's filter of Bob Weaver and yadif, https://ffmpeg.org/ffmpeg-filters.html#bwdif"""


def deinterlace(pictures: Iterable[av.VideoFrame | str]) -> Iterator[av.VideoFrame | str]:
    """The same pictures in the same number and order, interlaced ones deinterlaced; progressive ones pass as they are.

    The lines of a picture that are missing at its moment come from the pictures before and after it, so that each
    is held until the next one is there. If one could not be decoded, which its reason stands for, they are not
    looked for beyond it.
    """
    graph: _Deinterlacer | None = None
    for picture in pictures:
        if isinstance(picture, str) or not (picture.interlaced_frame or graph is not None):
            if graph is not None:
                yield from graph.finish()
                graph = None
            yield picture
            continue
        if graph is not None and not graph.takes(picture):
            yield from graph.finish()
            graph = None
        graph = graph or _Deinterlacer(picture)
        yield from graph.push(picture)
    if graph is not None:
        yield from graph.finish()


class _Deinterlacer:
    """The filter on pictures of one size and kind, from the first one on."""

    def __init__(self, picture: av.VideoFrame) -> None:
        self._kind = _kind(picture)
        self._graph = Graph()
        source = self._graph.add_buffer(
            width=picture.width,
            height=picture.height,
            format=picture.format,
            time_base=picture.time_base or Fraction(1, 25),
        )
        # One picture for one; those that say they are progressive are left alone.
        filter_ = self._graph.add(FILTER, "mode=send_frame:deint=interlaced")
        sink = self._graph.add("buffersink")
        source.link_to(filter_)
        filter_.link_to(sink)
        self._graph.configure()
        self._held: deque[av.VideoFrame] = deque()

    def takes(self, picture: av.VideoFrame) -> bool:
        """Whether the picture is of the same size and kind."""
        return _kind(picture) == self._kind

    def push(self, picture: av.VideoFrame) -> Iterator[av.VideoFrame]:
        """Take one more; gives those that are done."""
        self._held.append(picture)
        self._graph.vpush(picture)
        yield from self._done()

    def finish(self) -> Iterator[av.VideoFrame]:
        """There is none behind the last one."""
        with suppress(FFmpegError):
            self._graph.vpush(None)
        yield from self._done()
        yield from self._held  # what the filter kept to itself comes as it was

    def _done(self) -> Iterator[av.VideoFrame]:
        while self._held:
            try:
                done = self._graph.vpull()
            except (FFmpegError, BlockingIOError, EOFError):
                return
            taken = self._held.popleft()
            done.pts = taken.pts  # the filter counts in halves
            if taken.time_base:
                done.time_base = taken.time_base
            yield done


def _kind(picture: av.VideoFrame) -> tuple[int, int, str]:
    return picture.width, picture.height, picture.format.name
