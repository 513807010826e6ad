"""Box trackers of OpenCV, made deterministic and safe, that check a mask tracker."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Generic, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image
from tracking3d.trackers.crops import clip_box


@dataclass(frozen=True)
class BoxOffset:
    """How the object's box lies to the one that a tracker follows, which keeps to what it was started on."""

    shift: tuple[float, float] = (0.0, 0.0)  # shift of the corner, in widths and heights of the box
    factor: tuple[float, float] = (1.0, 1.0)  # factor of width and height

    @classmethod
    def between(cls, followed: Box, told: Box) -> Self:
        """From the box that is followed to the given one."""
        x, y, width, height = followed
        return cls(((told[0] - x) / width, (told[1] - y) / height), (told[2] / width, told[3] / height))

    def apply(self, box: Box) -> Box:
        """The object's box, given the tracked ``box``."""
        x, y, width, height = box
        across, down = self.factor
        return x + self.shift[0] * width, y + self.shift[1] * height, across * width, down * height


class OpenCvBoxes:
    """A box tracker of OpenCV on RGB images at a chosen resolution.

    Args:
        tracker: The tracker, not started yet.
        image: ``(H, W, 3)`` RGB, the first frame.
        box: ``(x, y, w, h)`` in it, in pixels; the part inside the image is tracked.
        resolution: Scale of the image that the tracker sees.
    """

    def __init__(self, tracker: cv2.Tracker, image: Image, box: Box, resolution: float = 1.0) -> None:
        self._scale = resolution
        self._tracker: cv2.Tracker | None = tracker
        view = self._view(image)
        visible = clip_box(box, image.shape) or (0.0, 0.0, 1.0, 1.0)
        x, y, width, height = (value * self._scale for value in visible)
        # A filter needs a few pixels: a smaller box is grown about its corner.
        rectangle = [int(x), int(y), max(round(width), 4), max(round(height), 4)]
        rectangle[0] = max(min(rectangle[0], view.shape[1] - rectangle[2]), 0)
        rectangle[1] = max(min(rectangle[1], view.shape[0] - rectangle[3]), 0)
        self._lookahead = Lookahead[Box | None]()
        cv2.setRNGSeed(0)
        try:
            self._tracker.init(view, rectangle)
        except cv2.error:  # an image too small or a box too slender for a filter
            self._tracker = None

    def announce(self, image: Image) -> None:
        """Look for the box in another thread already; ``update`` is called with this very image next, if at all."""
        self._lookahead.begin(image, partial(self._find, image))

    def update(self, image: Image) -> Box | None:
        """The box in the next image, or None if the tracker has lost the object."""
        return self._lookahead.result(image, partial(self._find, image))

    def _find(self, image: Image) -> Box | None:
        if self._tracker is None:
            return None
        cv2.setRNGSeed(0)
        try:
            found, box = self._tracker.update(self._view(image))
        except cv2.error:  # the object has shrunk to nothing
            return None
        x, y, width, height = (value / self._scale for value in box)
        return (x, y, width, height) if found else None

    def _view(self, image: Image) -> NDArray[np.uint8]:
        bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        if self._scale == 1:
            return bgr
        return cv2.resize(bgr, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA)


T = TypeVar("T")


class Lookahead(Generic[T]):
    """The job for one announced image, if there is one.

    Nothing that the job reads may change before `result` or `discard`.
    """

    def __init__(self) -> None:
        self._job: tuple[Image, Future[T]] | None = None

    def begin(self, image: Image, job: Callable[[], T]) -> None:
        """Begin the job for ``image``."""
        self.discard()
        self._job = image, _thread().submit(job)

    def result(self, image: Image, job: Callable[[], T]) -> T:
        """What the job that was begun for this very image gives; if there is none, what ``job`` gives now.

        Raises:
            Exception: What the job ended with.
        """
        begun, self._job = self._job, None
        if begun is not None:
            result = begun[1].result()
            if begun[0] is image:
                return result
        return job()

    def discard(self) -> None:
        """Forget the job; if it has begun, wait until it has ended."""
        job, self._job = self._job, None
        if job is not None and not job[1].cancel():
            job[1].exception()


@functools.cache
def _thread() -> ThreadPoolExecutor:
    """The thread of all jobs."""
    return ThreadPoolExecutor(1, "tracking3d-lookahead")


# A thread does not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread.cache_clear)
