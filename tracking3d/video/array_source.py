"""Frames from the caller's own arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video.selection import EVERY_FRAME, within
from tracking3d.video.source import Intrinsics, check_frames


@dataclass(frozen=True, eq=False)
class ArraySource:
    """Any iterable of ``(H, W, 3)`` uint8 RGB arrays, taken one at a time.

    See `tracking3d.video.source.FrameSource` for the other attributes.

    Attributes:
        rate: Arrays per second, which times are counted by; None if unknown.
    """

    arrays: Iterable[Any]
    selection: range = EVERY_FRAME
    name: str = "the iterable of frames"
    rate: float | None = None
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""

    @property
    def fps(self) -> float | None:
        """Selected arrays per second, if given."""
        return None if self.rate is None else self.rate / self.selection.step

    @property
    def count(self) -> int | None:
        """Number of selected frames, if the iterable has a length."""
        return len(within(self.selection, len(self.arrays))) if isinstance(self.arrays, Sized) else None

    @property
    def repeatable(self) -> bool:
        """Whether the iterable can be gone through again, as an iterator cannot."""
        return not isinstance(self.arrays, Iterator)

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Give the selected frames; an `InputError` ends it at the first item that is no RGB array."""
        return check_frames(self._frames(), self.name)

    def _frames(self) -> Iterator[Frame]:
        wanted = self.selection
        for index, array in islice(enumerate(self.arrays), wanted.start, wanted.stop, wanted.step):
            if not (
                isinstance(array, np.ndarray)
                and array.dtype == np.uint8
                and array.ndim == 3
                and array.shape[2] == 3
                and array.size
            ):
                raise InputError(
                    f"Frame {index} of {self.name} is {_describe(array)}; give (H, W, 3) uint8 RGB arrays."
                )
            # A copy, because callers like to decode every frame into one buffer.
            seconds = None if self.rate is None else index / self.rate
            yield Frame(index, array.copy(), seconds, f"frame {index}")


def _describe(item: Any) -> str:
    return (
        f"a {item.shape} array of {item.dtype}"
        if isinstance(item, np.ndarray)
        else f"a {type(item).__name__}"
    )
