"""Reading the frames of a source: once in the order in which they are tracked, and again in order of time."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame, MaskEstimate, SkippedFrame
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.runtime.concurrency import read_ahead, with_next
from tracking3d.video.both_ways import both_ways
from tracking3d.video.source import FrameSource


def read_timed(source: FrameSource) -> Generator[Frame | SkippedFrame]:
    """Read the frames of a source, each with the time that reading took; without it if the source is live."""
    frames, started = iter(source), time.perf_counter()
    try:
        for frame in frames:
            if isinstance(frame, Frame) and source.repeatable:
                yield replace(frame, decoding=time.perf_counter() - started)
            else:
                yield frame
            started = time.perf_counter()
    finally:
        if isinstance(frames, Generator):
            frames.close()


def read_from(source: FrameSource, start_frame: int | None) -> Generator[Frame | SkippedFrame]:
    """Read the frames in the order in which they are tracked.

    Args:
        source: The source.
        start_frame: The prompt frame: it comes first, then those after it, then those before it, backwards. None
            gives all frames in order of time.

    Raises:
        InputError: If there is no such frame.
    """
    if start_frame is None:
        return read_timed(source)
    return both_ways(partial(read_timed, source), start_frame, source.name)


def read_with_next(
    source: FrameSource, frames: Iterable[Frame | SkippedFrame]
) -> Iterator[tuple[Frame | SkippedFrame, Frame | SkippedFrame | None]]:
    """Give each frame with the next one, which is read meanwhile; that of a live source is not known yet."""
    if not source.repeatable:
        for frame in frames:
            yield frame, None
        return
    with closing(read_ahead(frames)) as ahead:
        yield from with_next(ahead)


def read_again(source: FrameSource) -> Iterator[Frame]:
    """Read the frames once more, in order of time, without those that cannot be decoded."""
    with closing(read_timed(source)) as frames, closing(read_ahead(frames)) as ahead:
        for frame in ahead:
            if isinstance(frame, Frame):
                yield frame


def with_share(frame: Frame, objects: int) -> Frame:
    """The frame, with one object's share of the time that reading it took."""
    return replace(frame, decoding=frame.decoding / objects)


@dataclass(frozen=True)
class FrameOrder:
    """Frames numbered in the order in which they are shown.

    A solver takes frames for one after the other and counts the time between them by their indices. Frames from
    before the first one come when the last one is done; they are numbered on from there, so that time increases.
    """

    first: int  # index of the first frame
    last: int | None = None  # index of the last frame forwards; None until it is known

    def number_of(self, index: int) -> int:
        """The number of the frame with an index."""
        if self.last is None or index >= self.first:
            return index
        return self.last + self.first - index

    def number(self, frame: Frame) -> Frame:
        """The frame as the solver is shown it."""
        return replace(frame, index=self.number_of(frame.index))

    def index(self, estimate: FrameEstimate) -> FrameEstimate:
        """The solver's estimate, and those that it revises, under their frames' own indices."""
        if self.last is None:
            return estimate
        revised = tuple(map(self.index, estimate.revised))
        index = estimate.index
        if index > self.last:
            index = self.last + self.first - index
        return replace(estimate, index=index, revised=revised)


@dataclass(frozen=True, eq=False)
class SavedMasks:
    """What the mask tracker gave for each frame."""

    estimates: RefinedEstimates  # the estimates of the run, in whose folder the masks are
    initial: Mapping[int, tuple[float, str]]  # score and reason of every frame's initial mask, by index

    def has_mask(self, index: int) -> bool:
        """Whether the mask tracker saw the object in a frame."""
        return self.estimates.causal[index].iou_initial is not None

    def of(self, frame: Frame) -> MaskEstimate:
        """The initial mask of a frame."""
        return self.estimate(frame.index, self.estimates.initial_mask(frame.index))

    def estimate(self, index: int, mask: NDArray[np.bool_] | None) -> MaskEstimate:
        """The initial mask ``(H, W)`` of a frame with its score and reason."""
        score, reason = self.initial.get(index, (1.0, ""))
        occluder = None if mask is None else self.estimates.occluder(index)
        return MaskEstimate(None if mask is None else mask.astype(np.float32), score, reason, occluder)

    def with_masks(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, MaskEstimate]]:
        """Frames with their initial masks."""
        return ((frame, self.of(frame)) for frame in frames)
