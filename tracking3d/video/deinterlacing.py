"""Deinterlacing of pictures whose odd and even lines were taken at different times."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from fractions import Fraction

import av
from av.error import FFmpegError
from av.filter import Graph

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
