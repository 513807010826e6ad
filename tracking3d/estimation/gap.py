"""Frames of a source that has ended, for a solver: next to a keyframe, or as photos without order."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame, MaskEstimate


@dataclass(frozen=True)
class ModelCoverage:
    """The part of a video that a model explains."""

    confidence: Mapping[int, float]  # of each frame that was estimated with it, by index
    anchors: frozenset[int]  # keyframes of which the pose is reliable: the object can be tracked from there


@dataclass(frozen=True, eq=False)
class Gap:
    """Consecutive frames, some of which the object's model does not explain, next to a keyframe."""

    anchor: Frame  # the keyframe's frame
    # the frames with their initial masks, the nearest to anchor first; they can be iterated once
    frames: Iterable[tuple[Frame, MaskEstimate]]
    backwards: bool  # whether they come before anchor


@dataclass(frozen=True)
class PhotoSet:
    """Frames as photos, which need not follow each other closely; ``read`` gives some, as often as it is called."""

    indices: tuple[int, ...]  # of those in which the object was seen, in order
    read: Callable[[Collection[int]], Iterator[tuple[Frame, MaskEstimate]]]


@dataclass(frozen=True, eq=False)
class PhotoEstimates:
    """What a solver makes of a set of photos."""

    estimates: tuple[FrameEstimate, ...]  # with the map of those that were joined; empty if there is none
    reason: str  # which photos are not joined, and what to do about that; empty if all are
