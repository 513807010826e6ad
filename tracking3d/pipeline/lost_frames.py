"""Before the final refinement: what can be done about frames in which the object was lost, or if nothing started.

The model is extended over them from the frames around (`gap_tracker`). If too many are left, the video is tracked once
more from another frame (`second_start`), and whichever start explains more is refined. Images that follow each other in
wide steps, or in no order, are joined as photos. All of it together has a budget, see `TriedFrames`.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import UNALIGNED_MAP, FrameEstimate, Status
from tracking3d.estimation.online.features.klt import grey
from tracking3d.estimation.online.initialization.start_window import score_starts
from tracking3d.estimation.solver import Gap, PhotoSet
from tracking3d.frames import TRACKED_CONFIDENCE, Box, Frame, MaskEstimate, mask_iou_or_none
from tracking3d.pipeline.frame_reading import SavedMasks, read_again, read_timed
from tracking3d.pipeline.session import Session
from tracking3d.results.description import StartOfModel
from tracking3d.results.files import pack, unpack
from tracking3d.runtime.progress import report_each, report_progress
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.first_mask import mask_with_network
from tracking3d.video.both_ways import backwards, both_ways
from tracking3d.video.source import FrameSource

if TYPE_CHECKING:
    from tracking3d.trackers.segment.network import ObjectNetwork

_log = logging.getLogger(__name__)

_MIN_LOST = 0.05  # share of the frames from which something is done
_MIN_TRACKED = 0.5  # share of a photo set below which its start is doubted
_MIN_PHOTOS = 4  # photos with a mask
# Photos of a camera that stands still. The box of all masks is at most so many times as large as the usual one: IoU
# .907 -> .968 where it is 1.3 times, .940 -> .701 where twice. Beside it, and a margin in its sides, pictures scaled to
# so many pixels differ from what is the same in all by at most so much of its contrast (measured: .02 and .19; .87
# where the camera walks around, and .930 -> .867). Where the mean IoU of both masks is higher, the initial ones stay
# (fitted to two sets: .898, .907 -> .968, and .946, .939 -> .931).
_LOOSEST, _MARGIN, _COMPARED, _STILL, _ALIKE = 1.5, 0.1, 160, 0.5, 0.92
T = TypeVar("T")


@dataclass
class TriedFrames:
    """How many frames were tried once more by what: together at most as many as the video has.

    Only a second start that explains clearly more than the first one, in the frames so far, goes on beyond that.
    """

    most: int  # frames of the video
    by: Counter[str]  # frames that were tried, by what

    @property
    def left(self) -> int:
        """Frames that may still be tried."""
        return self.most - sum(self.by.values())

    def count(self, what: str, frames: Iterable[T]) -> Iterator[T]:
        """The same frames, counted as they are taken."""
        for one in frames:
            self.by[what] += 1
            yield one


def explain_lost_frames(session: Session, source: FrameSource, masks: SavedMasks) -> StartOfModel:
    """Track the object into frames in which it was lost though the mask tracker saw it, if there are many.

    Args:
        session: The object after its last frame, before `Session.refine`.
        source: The video, which can be read again.
        masks: The causal estimates and their initial masks.

    Returns:
        Where the model that is to be refined started.
    """
    tried = TriedFrames(len(masks.estimates.causal), Counter({"while tracking": session.tried}))
    start = _find_start_of_model(session, source, masks, tried)
    return replace(start, tried=dict(+tried.by))


def _find_start_of_model(
    session: Session, source: FrameSource, masks: SavedMasks, tried: TriedFrames
) -> StartOfModel:
    causal = masks.estimates.causal
    first = StartOfModel(session.first_index, "tracking began in this frame")
    advice = ""
    if needs_photo_start(session, source, masks):
        started, advice = start_from_photos(session, source, masks, tried)
        if started is not None:
            return started
    first = replace(first, advice=advice if source.fps is None else "")
    lost = [index for index, one in causal.items() if one.status is Status.LOST and masks.has_mask(index)]
    if len(lost) < max(1, _MIN_LOST * len(causal)):
        return first
    gaps = GapTracker(session, source, masks, tried)
    gaps.run({index: one.diagnostics.get(UNALIGNED_MAP, one.confidence) for index, one in causal.items()})
    second = try_second_start(session, source, masks, gaps, tried)
    if second is None:
        return first
    compared = (
        f"frame {second.frame} explains {second.explained} of {len(causal)} frames, one in frame {first.frame} "
        f"explains {second.explained_before}"
    )
    _log.info("A start in %s.", compared)
    return StartOfModel(second.frame, f"a start in {compared}", first.advice) if second.is_better else first


def needs_photo_start(session: Session, source: FrameSource, masks: SavedMasks) -> bool:
    """Whether there is no map with points, or too few images without times are `tracked`.

    A video that is too short for a map may get one at its end, and keeps it.
    """
    causal = masks.estimates.causal
    if sum(masks.has_mask(index) for index in causal) < _MIN_PHOTOS:
        return False
    tracked = sum(one.status is Status.TRACKED for one in causal.values())
    if source.fps is None and tracked < _MIN_TRACKED * len(causal):
        return True
    return session.lacks_points(ended=source.fps is not None)


def start_from_photos(
    session: Session, source: FrameSource, masks: SavedMasks, tried: TriedFrames
) -> tuple[StartOfModel | None, str]:
    """Join all frames as photos, and continue with that map if it explains more than what there is.

    Returns:
        Where the model started, None if it stays; and which photos are not joined, in words.
    """
    causal = masks.estimates.causal
    is_set = source.fps is None and not session.config.has_given_masks
    own = PhotoMasks(source, masks) if is_set else None

    def read(indices: Collection[int]) -> Iterator[tuple[Frame, MaskEstimate]]:
        wanted = frozenset(indices)
        frames = (frame for frame in read_again(source) if frame.index in wanted)
        return masks.with_masks(frames) if own is None else ((frame, own.of(frame)) for frame in frames)

    report_progress("joining photos")
    seen = tuple(sorted(index for index in causal if masks.has_mask(index) or (own and own.box)))
    attempt, advice = session.start_from_photos(PhotoSet(seen, read))
    if attempt is None:  # nothing but matches, which hardly cost anything, was tried
        return None, advice
    tried.by["photos"] += len(attempt.confidence)
    before = sum(one.status is Status.TRACKED for one in causal.values())
    explained = sum(one >= TRACKED_CONFIDENCE for one in attempt.confidence.values())
    _log.info("Photos joined: %d of %d frames explained, %d before.", explained, len(causal), before)
    if explained <= before:
        return None, ""
    session.adopt(attempt)
    for frame, mask in read(seen) if own and own.box else ():
        masks.estimates.put_initial_mask(frame.index, mask)
    reason = f"frames joined as photos explain {explained} of {len(causal)}, those before {before}"
    return StartOfModel(min(attempt.poses), reason, advice), advice


class PhotoMasks:
    """Masks of photos, each segmented by itself: through wide steps none can be carried.

    All have the same box, that of all initial masks: a mask that has lost a side of a thing which turns has lost it in
    some photos only. So this is for a camera that stands still; elsewhere initial masks are better, and where both are
    much alike too.

    Args:
        source: The photos.
        masks: Their initial masks.

    Attributes:
        box: ``(x, y, w, h)``; None if the initial masks stay.
    """

    def __init__(self, source: FrameSource, masks: SavedMasks) -> None:
        found = map(masks.estimates.initial_mask, masks.estimates.causal)
        boxes = np.array([box for mask in found if mask is not None and (box := box_of(mask)) is not None])
        self.box: Box | None = None
        self._masks = masks
        self._own: dict[int, tuple[bytes, bytes]] = {}  # masks and what is in front of the object, as bits
        if len(boxes):
            (left, top), (right, bottom) = boxes[:, :2].min(0), (boxes[:, :2] + boxes[:, 2:]).max(0)
            around = float(left), float(top), float(right - left), float(bottom - top)
            usual = float(np.median(boxes[:, 2] * boxes[:, 3]))
            if around[2] * around[3] <= _LOOSEST * usual and _stands_still(source, around):
                self.box = around
                if np.mean([self._agreement(frame) for frame in read_again(source)]) > _ALIKE:
                    self.box = None

    def _agreement(self, frame: Frame) -> float:
        """IoU of a photo's own mask and its initial one."""
        own, before = self.of(frame).found, self._masks.of(frame).found
        return 0.0 if own is None else mask_iou_or_none(own, before) or 0.0

    @cached_property
    def _network(self) -> ObjectNetwork:
        from tracking3d.trackers.segment.network import ObjectNetwork  # slow to import

        return ObjectNetwork()

    def of(self, frame: Frame) -> MaskEstimate:
        """The mask of a photo; the initial one if the user has given it, or there is no box for all."""
        before = self._masks.of(frame)
        if self.box is None or self._masks.estimates.is_given(frame.index):
            return before
        if frame.index not in self._own:
            likely, hidden = self._network.segment_box(frame.image, self.box)
            found = mask_with_network(frame.image, self.box, likely) >= 0.5
            self._own[frame.index] = pack(found), pack((hidden > 0.5) & ~found)
        mask, occluder = (unpack(bits, frame.image.shape[:2]) for bits in self._own[frame.index])
        return replace(before, mask=mask.astype(np.float32), occluder=occluder)


def _stands_still(source: FrameSource, around: Box) -> bool:
    """Whether what pictures show outside a box ``(x, y, w, h)``, and a margin around it, is mostly the same in all."""
    pictures = list[NDArray[np.float32]]()
    for frame in read_again(source):
        image = grey(frame.image)
        scale = _COMPARED / max(image.shape)
        size = [max(round(scale * length), 1) for length in image.shape[::-1]]
        pictures.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32))
    beside, margin = np.ones(pictures[0].shape, bool), _MARGIN * max(around[2:])
    rows, columns = (
        slice(max(round(scale * (at - margin)), 0), max(round(scale * (at + length + margin)), 0))
        for at, length in ((around[1], around[3]), (around[0], around[2]))
    )
    beside[rows, columns] = False
    if not beside.any():
        return False
    seen = np.stack([picture[beside] for picture in pictures])
    same = np.median(seen, axis=0)
    return float(np.abs(seen - same).mean()) <= max(_STILL * float(same.std()), 1.0)


# A second start: if what began with the first frame explains too little of a video, another window may explain more.
#
# The object is tracked once more with the same masks, from the frame that is best to start with: forwards to the end,
# and then backwards. Whichever start explains more frames is refined.

_SAMPLED = 2  # every n-th frame is looked at for a start
_MAX_UNEXPLAINED = 0.25  # share of the frames without a reliable pose up to which the first start stays
# Frames, and share of all, in which a start may explain none, as that of a plain object does (chosen: a first map takes
# up to some 30 frames).
_MOST_IN_VAIN = 60, 0.25
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
    session: Session, source: FrameSource, masks: SavedMasks, gaps: GapTracker, tried: TriedFrames
) -> SecondStart | None:
    """Track from another frame, and continue with that start if it explains more; None if none is needed, or possible.

    It ends early if it can no longer explain enough, or does not explain more of the frames so far when none are left.

    Args:
        session: The object after its last frame.
        source: The video.
        masks: The initial masks.
        gaps: What the first start explains.
        tried: How many frames were tried already.
    """
    frames, plain = len(masks.estimates.causal), session.lacks_points(ended=False)

    def goes_on(found: Mapping[int, FrameEstimate]) -> bool:
        now = {index: one.confidence for index, one in found.items()}
        inliers = [one.diagnostics["inliers"] for one in found.values() if one.diagnostics]
        return may_win(now, gaps.confidence, frames, tried.left, plain and bool(inliers) and not any(inliers))

    if tried.left <= 0 or not session.order_of_time or len(gaps.unexplained) <= _MAX_UNEXPLAINED * frames:
        return None
    start = find_start(source, masks)
    if start is None:
        return None
    again = partial(read_timed, source)
    every = report_each("tracking from another frame", both_ways(again, start, source.name), source.count)
    with closing(every) as frames_both_ways:
        wanted = (frame for frame in frames_both_ways if isinstance(frame, Frame))
        known = (frame for frame in wanted if frame.index in masks.estimates.causal)
        shown = masks.with_masks(tried.count("second start", known))
        attempt = session.attempt(shown, goes_on)
    if attempt is None:
        return None
    second = SecondStart(start, _explained(attempt.confidence), _explained(gaps.confidence))
    if second.is_better:
        session.adopt(attempt)
    return second


def may_win(
    now: Mapping[int, float],
    before: Mapping[int, float],
    frames: int,
    left: int,
    without_points: bool = False,
) -> bool:
    """Whether a second start goes on, by the confidence in each frame now and with the first start, by index.

    If neither start has a map with points, the second one may not begin with frames that it does not explain.
    """
    explained = _explained(now)
    most_in_vain = 0 if without_points else max(_MOST_IN_VAIN[0], _MOST_IN_VAIN[1] * frames)
    if not explained and len(now) > most_in_vain:
        return False
    if explained and explained + frames - len(now) <= _MIN_GAIN * _explained(before):
        return False
    shared = _explained({index: before.get(index, 0.0) for index in now})
    return left > 0 or explained > _MIN_GAIN * shared


def _explained(confidence: Mapping[int, float]) -> int:
    return sum(one >= TRACKED_CONFIDENCE for one in confidence.values())


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


# Before the final refinement: the object is tracked into the frames that the causal estimates do not explain.
#
# In short::
#
#     for frame in frames backwards:      # from each keyframe to the frames before it that are not explained
#         session.extend(...)
#     for frame in frames forwards:       # from each keyframe, new ones too, to those that are left after it
#         session.extend(...)


class GapTracker:
    """Tracks one object into the frames that are not explained, see the module.

    Args:
        session: The object after its last frame.
        source: The video, which can be read again.
        masks: The initial masks.
        tried: How many frames were tried already.

    Attributes:
        confidence: Of the best pose in each frame, of the one model that is refined.
    """

    def __init__(self, session: Session, source: FrameSource, masks: SavedMasks, tried: TriedFrames) -> None:
        self._session, self._source, self._masks, self._tried = session, source, masks, tried
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
                    inside = self._tried.count("gaps", islice(frames, min(length, max(self._tried.left, 0))))
                    self._extend(Gap(frame, self._masks.with_masks(inside), backwards))
                if not gaps or self._tried.left <= 0:
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
