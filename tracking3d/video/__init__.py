"""Frame sources and the video writer."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_HOME = {
    "FrameSource": "source",
    "Intrinsics": "source",
    "LatestFrames": "latest_frames",
    "VideoWriter": "writer",
    "natural_order": "selection",
    "open_source": "opening",
    "parse_selection": "selection",
    "read_image": "image_file",
}


def __getattr__(name: str) -> Any:
    """Import the public names on first use: whoever reads ``--frames`` need not wait for OpenCV and FFmpeg."""
    if name not in _HOME:
        raise AttributeError(f"module 'tracking3d.video' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"tracking3d.video.{_HOME[name]}"), name)
