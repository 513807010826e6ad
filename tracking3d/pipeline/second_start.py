"""A second start: if what began with the first frame explains too little of a video, another window may explain more.

The object is tracked once more with the same masks, from the frame that is best to start with: forwards to the end, and
then backwards. Whichever start explains more frames is refined.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import grey
from tracking3d.estimation.online.initialization.start_window import score_starts
from tracking3d.frames import TRACKED_CONFIDENCE, Frame
from tracking3d.pipeline.frame_reading import read_again, read_timed
from tracking3d.pipeline.gap_tracker import GapTracker
from tracking3d.pipeline.saved_masks import SavedMasks
from tracking3d.pipeline.session import Session
from tracking3d.runtime.progress import report_each
from tracking3d.video.both_ways import both_ways
from tracking3d.video.source import FrameSource

_SAMPLED = 2  # every n-th frame is looked at for a start
_MAX_UNEXPLAINED = 0.25  # share of the frames without a reliable pose up to which the first start stays
_MIN_GAIN = 1.1  # times as many frames as the first start's must be explained


@dataclass(frozen=True)
class SecondStart:
    """What came of a second start."""

    frame: int  # index of the frame that it was made with
    explained: int  # how many frames have a reliable pose by it
    explained_before: int  # how many have one by the first start

    @property
    def is_better(self) -> bool:
        """Whether it explains clearly more frames than the first start."""
        return self.explained > _MIN_GAIN * self.explained_before


def try_second_start(
    session: Session, source: FrameSource, masks: SavedMasks, gaps: GapTracker
) -> SecondStart | None:
    """Track from another frame, and continue with that start if it explains more; None if none is needed, or possible.

    Args:
        session: The object after its last frame.
        source: The video.
        masks: The initial masks.
        gaps: What the first start explains.
    """
    frames = len(masks.estimates.causal)
    if not session.order_of_time or len(gaps.unexplained) <= _MAX_UNEXPLAINED * frames:
        return None
    start = find_start(source, masks)
    if start is None:
        return None
    again = partial(read_timed, source)
    every = report_each("tracking from another frame", both_ways(again, start, source.name), source.count)
    with closing(every) as frames_both_ways:
        wanted = (frame for frame in frames_both_ways if isinstance(frame, Frame))
        attempt = session.attempt(
            masks.with_masks(frame for frame in wanted if frame.index in masks.estimates.causal)
        )
    if attempt is None:
        return None
    before = sum(known >= TRACKED_CONFIDENCE for known in gaps.confidence.values())
    second = SecondStart(start, sum(one >= TRACKED_CONFIDENCE for one in attempt.confidence.values()), before)
    if second.is_better:
        session.adopt(attempt)
    return second


def find_start(source: FrameSource, masks: SavedMasks) -> int | None:
    """The frame that is best to start with, not the first one; None if the object can be followed nowhere."""
    first = min(masks.estimates.causal)

    def looked_at() -> Iterator[tuple[int, NDArray[np.uint8], NDArray[np.bool_] | None]]:
        with closing(report_each("looking for a start", read_again(source), source.count)) as frames:
            for frame in islice(frames, None, None, _SAMPLED):
                yield frame.index, grey(frame.image), masks.of(frame).found

    scores = {
        index: score for index, score in score_starts(looked_at()).items() if index != first and score > 0
    }
    return max(scores, key=lambda index: scores[index], default=None)
