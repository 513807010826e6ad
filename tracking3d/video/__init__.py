"""Frame sources and the video writer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tracking3d.runtime.deferred_import import import_on_use

if TYPE_CHECKING:
    from tracking3d.video.image_file import read_image
    from tracking3d.video.latest_frames import LatestFrames
    from tracking3d.video.opening import open_source
    from tracking3d.video.source import FrameSource, Intrinsics, natural_order, parse_selection
    from tracking3d.video.writer import VideoWriter

__all__ = [
    "FrameSource",
    "Intrinsics",
    "LatestFrames",
    "VideoWriter",
    "natural_order",
    "open_source",
    "parse_selection",
    "read_image",
]

_HOME = {
    "FrameSource": "tracking3d.video.source",
    "Intrinsics": "tracking3d.video.source",
    "LatestFrames": "tracking3d.video.latest_frames",
    "VideoWriter": "tracking3d.video.writer",
    "natural_order": "tracking3d.video.source",
    "open_source": "tracking3d.video.opening",
    "parse_selection": "tracking3d.video.source",
    "read_image": "tracking3d.video.image_file",
}


# Whoever reads ``--frames`` need not wait for OpenCV and FFmpeg.
__getattr__ = import_on_use(__name__, _HOME)
