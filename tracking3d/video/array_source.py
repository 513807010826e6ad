"""Frames that the caller of the library has in memory."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sized
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.video.source import EVERY_FRAME, Intrinsics, check_frames, within


@dataclass(frozen=True, eq=False)
class ArraySource:
    """Any iterable of images, taken one at a time.

    See `tracking3d.video.source.FrameSource` for the other attributes.
    """

    images: Iterable[Any]  # (H, W, 3) uint8 RGB arrays of one size; frames of another size are skipped
    selection: range = EVERY_FRAME  # which of them are taken
    name: str = "the iterable of frames"
    rate: float | None = None  # images per second, which times are counted by; None if unknown
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    # Makes such an array of an item, given its position. The items may then also be `Frame` and
    # `SkippedFrame`, and sizes are left to whoever takes the frames.
    convert: Callable[[Any, int], Image] | None = None

    @property
    def fps(self) -> float | None:
        """Selected images per second, if known."""
        return None if self.rate is None else self.rate / self.selection.step

    @property
    def count(self) -> int | None:
        """Number of selected frames, if the iterable tells its length."""
        length = len(self.images) if isinstance(self.images, Sized) else getattr(self.images, "count", None)
        return len(within(self.selection, length)) if isinstance(length, int) else None

    @property
    def indices(self) -> Collection[int] | None:
        """Indices of the frames, if the iterable tells its length; items may have indices of their own."""
        if isinstance(self.images, list | tuple) and self.convert is not None:
            wanted = self.images[self.selection.start : self.selection.stop : self.selection.step]
            own = [item.index for item in wanted if isinstance(item, Frame | SkippedFrame)]
            if own:
                return frozenset(own) if len(own) == len(wanted) else None
        if not isinstance(self.images, Sized):
            return None if self.selection == EVERY_FRAME else self.selection
        return within(self.selection, len(self.images))

    @property
    def repeatable(self) -> bool:
        """Whether the iterable can be gone through again, as an iterator cannot."""
        return bool(getattr(self.images, "repeatable", not isinstance(self.images, Iterator)))

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Give the selected frames; an `InputError` ends it at the first item that is no image."""
        frames = self._frames()
        return check_frames(frames, self.name) if self.convert is None else frames

    def _frames(self) -> Iterator[Frame | SkippedFrame]:
        wanted = self.selection
        for index, item in islice(enumerate(self.images), wanted.start, wanted.stop, wanted.step):
            seconds = None if self.rate is None else index / self.rate
            if self.convert is None:
                yield Frame(index, _copied(item, index, self.name), seconds, f"frame {index}")
            elif isinstance(item, SkippedFrame):
                yield item
            elif isinstance(item, Frame):
                yield replace(item, image=self.convert(item.image, item.index))
            else:
                yield Frame(index, self.convert(item, index), seconds)


def _copied(item: Any, index: int, name: str) -> Image:
    """A copy of an array, because callers like to decode every frame into one buffer."""
    is_array = isinstance(item, np.ndarray)
    if not (is_array and item.dtype == np.uint8 and item.ndim == 3 and item.shape[2] == 3 and item.size):
        what = f"a {item.shape} array of {item.dtype}" if is_array else f"a {type(item).__name__}"
        raise InputError(f"Frame {index} of {name} is {what}; give (H, W, 3) uint8 RGB arrays.")
    image: Image = item.copy()
    return image
