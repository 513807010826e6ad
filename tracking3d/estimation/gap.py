"""Frames that a solver is to track the object through, from a keyframe next to them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from tracking3d.frames import Frame, MaskEstimate


@dataclass(frozen=True)
class ModelCoverage:
    """The part of a video that a model explains.

    Attributes:
        confidence: Of each frame that was estimated with it, by index.
        anchors: Keyframes of which the pose is reliable: the object can be tracked from there.
    """

    confidence: Mapping[int, float]
    anchors: frozenset[int]


@dataclass(frozen=True, eq=False)
class Gap:
    """Consecutive frames, some of which the object's model does not explain, next to a keyframe.

    Attributes:
        anchor: The keyframe's frame.
        frames: The frames with their initial masks, the nearest to ``anchor`` first; they can be iterated once.
        backwards: Whether they come before ``anchor``.
    """

    anchor: Frame
    frames: Iterable[tuple[Frame, MaskEstimate]]
    backwards: bool
