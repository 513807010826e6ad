"""Opening a frame source from a path, address or camera number."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.frames import Image
from tracking3d.video.addresses import SCHEMES, check_source_name, scheme_of
from tracking3d.video.array_source import ArraySource
from tracking3d.video.given_rates import FPS, validate_fps
from tracking3d.video.image_file import is_still_image
from tracking3d.video.image_sequence import ImageSequence
from tracking3d.video.live_camera import LiveCamera
from tracking3d.video.selection import parse_selection
from tracking3d.video.source import FrameSource
from tracking3d.video.stream import open_stream
from tracking3d.video.video_file import VideoFile


def open_source(
    source: str | Path | Iterable[Image], frames: str | None = None, fps: float | None = None
) -> FrameSource:
    """Open a video file, a folder or pattern of images, a camera, a video by its address, or any iterable of arrays.

    Args:
        source: A path; a pattern such as ``"shots/*.png"`` (``**`` for all subfolders); the number of a
            camera, such as ``"0"``; an address that begins with http, https, rtsp or rtsps; or an iterable of
            ``(H, W, 3)`` uint8 RGB arrays. A text that exists as a path is taken as a path.
        frames: ``START:STOP:STEP`` to select frames (see `parse_selection`); frames keep the source's index.
        fps: Frames per second of images or arrays, which have no times of their own.

    Raises:
        InputError: If there is nothing that can be read as frames, the selection is bad or empty, or ``fps`` is given
            for a source that has times of its own.
    """
    selection, fps = parse_selection(frames), validate_fps(fps)
    if isinstance(source, str | Path):
        opened = _open_path(str(source), selection)
        if fps is None:
            return opened
        if not isinstance(opened, ImageSequence):
            raise InputError(f"{opened.name} has its own time stamps; {FPS} is for images only.")
        return replace(opened, rate=fps)
    if isinstance(source, Iterable):
        return ArraySource(source, selection, rate=fps)
    raise InputError(
        f"A {type(source).__name__} is not a source of frames; give a path or an iterable of RGB arrays."
    )


def _open_path(name: str, selection: range) -> FrameSource:
    check_source_name(name)
    path = Path(name).expanduser()
    try:
        if path.is_dir():
            return ImageSequence.open(name, list(path.iterdir()), selection)
        if path.exists():
            return _open_file(name, path, selection)
    except (OSError, ValueError) as error:  # no permission; a name that no file can have
        raise InputError(f"{name} cannot be opened: {getattr(error, 'strerror', None) or error}.") from error
    if name.isascii() and name.isdigit():
        return LiveCamera.open(int(name), selection)
    if scheme_of(name) in SCHEMES:
        return open_stream(name, selection)
    found = glob.iglob(str(path), recursive=True)  # noqa: PTH207 (Path.glob takes no absolute pattern)
    return ImageSequence.open(name, map(Path, found), selection, chosen=True)


def _open_file(name: str, path: Path, selection: range) -> VideoFile:
    if path.stat().st_size == 0:
        raise InputError(f"{name} is empty; give a video file or a folder of images.")
    if is_still_image(path):
        raise InputError(f"{name} is a single image; give its folder, or a video.")
    return VideoFile.open(name, path, selection)
