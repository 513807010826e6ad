"""The object cut out of the video: PNG with alpha, or a video with alpha, VP9 in WebM and ProRes 4444 in QuickTime.

Alpha is straight, not premultiplied: colours are the video's up to a few pixels beyond the outline and black elsewhere.
Frames that were skipped, or whose mask is empty, are wholly transparent. The videos run as fast as the source.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.errors import InputError
from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.training_images import cut_out


def write_cut_outs(run: ExportedRun, folder: Path) -> None:
    """Write one PNG a frame, numbered by frame index."""
    folder.mkdir()
    for index, image in cut_outs(run):
        Pillow.fromarray(image).save(folder / f"{index:06d}.png")


def cut_outs(run: ExportedRun) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Index and ``(H, W, 4)`` RGBA of every frame of the span, in order."""
    nothing = np.zeros((run.camera.height, run.camera.width, 4), np.uint8)
    coming = iter(run.span)
    for frame in run.pictures():
        for index in coming:
            if index == frame.index:
                yield index, cut_out(frame.image, run.mask(index))
                break
            yield index, nothing
    for index in coming:
        yield index, nothing


def write_alpha_video(
    run: ExportedRun, path: Path, encoder: str, container: str, pixel_format: str, options: dict[str, str]
) -> None:
    """Write the cut-outs as one video.

    Raises:
        InputError: If this build of FFmpeg has no such encoder.
    """
    if encoder not in av.codecs_available:
        raise InputError(f"The FFmpeg bundled with PyAV has no encoder {encoder}; use the format cut-outs.")
    # Chroma of half the width needs even sizes; the added row or column is transparent.
    height, width = (side + side % 2 for side in (run.camera.height, run.camera.width))
    rate = Fraction(run.fps / run.span.step).limit_denominator(1001)
    reformatter = VideoReformatter()
    with av.open(str(path), "w", format=container) as file:
        stream = file.add_stream(encoder, rate=rate, options=options)
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, pixel_format
        stream.codec_context.colorspace = Colorspace.ITU709
        stream.codec_context.color_range = ColorRange.MPEG
        for _, image in cut_outs(run):
            padded = np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)))
            frame = reformatter.reformat(
                av.VideoFrame.from_ndarray(padded, format="rgba"),
                format=pixel_format,
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
            )
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))


write_vp9 = partial(
    write_alpha_video,
    encoder="libvpx-vp9",
    container="webm",
    pixel_format="yuva420p",
    options={"crf": "18", "b": "0", "deadline": "good", "cpu-used": "4", "auto-alt-ref": "0"},
)
write_prores = partial(
    write_alpha_video,
    encoder="prores_ks",
    container="mov",
    pixel_format="yuva444p10le",
    options={"profile": "4444", "alpha_bits": "16", "vendor": "apl0"},
)
