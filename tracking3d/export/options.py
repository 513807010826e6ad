"""What may be asked of an export."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Answers = Literal["final", "causal"]
Of = Literal["object", "camera"]
Unseen = Literal["close", "cut"]


@dataclass(frozen=True)
class ExportOptions:
    """What may be asked of an export; a format that has no use for an option refuses it.

    Attributes:
        answers: ``final`` takes the estimates of the final refinement if there are any, ``causal`` those before it.
        object_size: Metres of the longest side of the smallest box around the object; None leaves the run's unit.
        fps: Frames per second; None takes what the run knows.
        source: The video, if it is no longer where the run found it.
        of: ``object`` for poses ``T_cam_obj``, ``camera`` for those of a camera about the still object, ``T_obj_cam``.
        cut_out: Pictures as PNG that are transparent around the object, instead of whole ones with separate masks.
        images: Whether pictures are written if a format has room for them.
        undistorted: Masks and pictures as a camera without the distortion of the lens sees them, instead of as they
            were taken.
        frame: The frame that ``xy`` is in; None takes the first one with a pose.
        xy: Pixels on the object whose surface points are followed; empty for a grid over the object.
        start_time: Seconds from 1970 to the start of the video, for stamps of clocks; None takes the time at which the
            video was recorded, if it says, else one second.
        compressed_images: Whether the frames are written as JPEG into a recording that can do without.
        unseen: ``close`` keeps the surface that no frame has shown, which files mark; ``cut`` leaves it out.
    """

    answers: Answers = "final"
    object_size: float | None = None
    fps: float | None = None
    source: str | None = None
    of: Of = "object"
    cut_out: bool = False
    images: bool = True
    undistorted: bool = False
    frame: int | None = None
    xy: tuple[tuple[float, float], ...] = ()
    start_time: float | None = None
    compressed_images: bool = False
    unseen: Unseen = "close"
