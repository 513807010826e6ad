"""Making videos for the tests, and damaging them."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from tracking3d.frames import Frame, Image, SkippedFrame


def moving_picture(index: int, height: int = 64, width: int = 96) -> Image:
    """A picture that tells which frame it is: grey of ``8 index`` above, noise to fill packets below."""
    image = np.random.default_rng(index).integers(0, 256, (height, width, 3)).astype(np.uint8)
    image[: height // 2] = 8 * index
    return image


def shown_numbers(frames: Sequence[Frame | SkippedFrame]) -> list[int | None]:
    """Which `moving_picture` each frame shows; None where it was skipped."""
    return [
        round(frame.image[: frame.size[0] // 2].mean() / 8) if isinstance(frame, Frame) else None
        for frame in frames
    ]


def encode_video(
    path: Path,
    images: Sequence[Image],
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    rate: int = 10,
    milliseconds: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
) -> Path:
    """Encode ``images``; the suffix of ``path`` chooses the container. Times make the frame rate variable."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pix_fmt
        stream.codec_context.gop_size = 10
        if milliseconds is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for index, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts = index if milliseconds is None else milliseconds[index]
            frame.time_base = Fraction(1, rate) if milliseconds is None else Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def damage_packet(path: Path, number: int) -> int:
    """Overwrite the data of one packet with zeros; returns the index of the frame it held."""
    with av.open(str(path)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        position, payload, time = packets[number].pos, bytes(packets[number]), packets[number].pts
        index = sum(packet.pts < time for packet in packets)
    data = bytearray(path.read_bytes())
    start = data.index(payload, position)
    data[start : start + len(payload)] = bytes(len(payload))
    path.write_bytes(data)
    return index
