"""Frame sources and the video writer."""

from __future__ import annotations

from tracking3d.video.image_file import read_image
from tracking3d.video.latest_frames import LatestFrames
from tracking3d.video.opening import open_source
from tracking3d.video.selection import natural_order, parse_selection
from tracking3d.video.source import FrameSource, Intrinsics
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
