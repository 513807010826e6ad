"""Frames that differ by next to nothing: the estimates of a method should differ as little."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video.source import FrameSource, Intrinsics


@dataclass(frozen=True)
class NoisyFrames:
    """The frames of a source, each value one grey level higher, lower or as it was.

    See `tracking3d.video.source.FrameSource` for the attributes that are not named here.
    """

    source: FrameSource  # the frames as they are
    seed: int  # seed of the noise; every frame has its own, the same whenever it is read

    @property
    def name(self) -> str:
        """The source's."""
        return self.source.name

    @property
    def count(self) -> int | None:
        """The source's."""
        return self.source.count

    @property
    def fps(self) -> float | None:
        """The source's."""
        return self.source.fps

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The source's."""
        return self.source.intrinsics

    @property
    def intrinsics_origin(self) -> str:
        """The source's."""
        return self.source.intrinsics_origin

    @property
    def repeatable(self) -> bool:
        """The source's."""
        return self.source.repeatable

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """The frames with their noise."""
        for frame in self.source:
            if isinstance(frame, Frame):
                noise = np.random.default_rng((self.seed, frame.index)).integers(-1, 2, frame.image.shape)
                frame = replace(frame, image=np.clip(frame.image + noise, 0, 255).astype(np.uint8))
            yield frame
