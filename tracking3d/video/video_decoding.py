"""Decoding a video stream so that every picture keeps its index, even if some cannot be decoded."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress

import av
from av.container import InputContainer
from av.error import FFmpegError
from av.video.stream import VideoStream

from tracking3d.video.codec_threads import codec_threads

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
