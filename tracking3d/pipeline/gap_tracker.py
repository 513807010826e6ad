"""Before the final refinement: the object is tracked into the frames that the causal estimates do not explain.

In short::

    for frame in frames backwards:      # from each keyframe to the frames before it that are not explained
        session.extend(...)
    for frame in frames forwards:       # from each keyframe, new ones too, to those that are left after it
        session.extend(...)
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator, Mapping
from contextlib import closing
from functools import partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.gap import Gap
from tracking3d.frames import TRACKED_CONFIDENCE, Frame
from tracking3d.pipeline.frame_reading import read_again, read_timed
from tracking3d.pipeline.saved_masks import SavedMasks
from tracking3d.pipeline.session import Session
from tracking3d.runtime.progress import report_each
from tracking3d.video.both_ways import backwards
from tracking3d.video.source import FrameSource


class GapTracker:
    """Tracks one object into the frames that are not explained, see the module.

    Args:
        session: The object after its last frame.
        source: The video, which can be read again.
        masks: The initial masks.

    Attributes:
        confidence: Of the best pose in each frame, of the one model that is refined.
    """

    def __init__(self, session: Session, source: FrameSource, masks: SavedMasks) -> None:
        self._session, self._source, self._masks = session, source, masks
        causal = masks.estimates.causal
        self._frames_taken = frozenset(causal)
        self.confidence = {index: one.confidence for index, one in causal.items()}
        self._anchors: set[int] = set()
        self._poses: dict[int, NDArray[np.float64]] = {}

    def run(self, known: Mapping[int, float]) -> None:
        """Extend the model, if it can be extended.

        Args:
            known: The confidence of the causal estimates with the model that each was made with, by frame index.
        """
        explained = self._session.begin_extension(known)
        if explained is None:
            return
        self.confidence = dict(explained.confidence)
        self._anchors = set(explained.anchors)
        for order in (True, False):
            self._sweep(backwards=order)
        self._session.end_extension(self._poses, max(self._frames_taken))

    @property
    def unexplained(self) -> set[int]:
        """Frames without a reliable pose, though the mask tracker saw the object."""
        return {
            index
            for index in self._frames_taken
            if self.confidence.get(index, 0.0) < TRACKED_CONFIDENCE and self._masks.has_mask(index)
        }

    def _sweep(self, *, backwards: bool) -> None:
        """Go through the video once, and track from each keyframe into the unexplained frames that follow it."""
        gaps = dict(plan_gaps(self._frames_taken, self.unexplained, self._anchors, backwards))
        if not gaps:
            return
        with closing(self._frames(backwards)) as frames:
            for frame in frames:
                if length := gaps.pop(frame.index, 0):
                    self._extend(Gap(frame, self._masks.with_masks(islice(frames, length)), backwards))
                if not gaps:
                    return

    def _extend(self, gap: Gap) -> None:
        for estimate in self._session.extend(gap):
            if estimate.confidence > self.confidence.get(estimate.index, 0.0):
                self.confidence[estimate.index] = estimate.confidence
                if estimate.status is not Status.LOST:
                    self._poses[estimate.index] = np.asarray(estimate.T_cam_obj, np.float64)
            if estimate.keyframe and estimate.confidence >= TRACKED_CONFIDENCE:
                self._anchors.add(estimate.index)

    def _frames(self, reverse: bool) -> Generator[Frame]:
        """The frames that have an estimate, in one of the two orders."""
        stage = "tracking backwards" if reverse else "tracking forwards"
        frames: Iterable[object] = (
            backwards(partial(read_timed, self._source), max(self._frames_taken) + 1)
            if reverse
            else read_again(self._source)
        )
        with closing(report_each(stage, frames, self._source.count)) as each:
            for frame in each:
                if isinstance(frame, Frame) and frame.index in self._frames_taken:
                    yield frame


def plan_gaps(
    frames: Iterable[int], unexplained: set[int], anchors: set[int], backwards: bool
) -> Iterator[tuple[int, int]]:
    """How many frames are to be tracked from which keyframe.

    Args:
        frames: Indices of all frames, in any order.
        unexplained: Those without a reliable pose.
        anchors: The keyframes that the object can be tracked from.
        backwards: Whether it is tracked from later frames into earlier ones.

    Yields:
        A keyframe, and how many frames after it (before it, backwards) end with the last unexplained frame before the
        next keyframe comes.
    """
    anchor, passed, length = None, 0, 0
    for index in sorted(frames, reverse=backwards):
        if index in anchors:
            if anchor is not None and length:
                yield anchor, length
            anchor, passed, length = index, 0, 0
            continue
        passed += 1
        if index in unexplained:
            length = passed
    if anchor is not None and length:
        yield anchor, length
