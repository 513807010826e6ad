"""A preview of a video before it is cut: a mask tracker alone, on small images, not every frame."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PluginChoice
from tracking3d.errors import PluginError
from tracking3d.frames import Frame, Prompt
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.submaps.cuts import Sighting
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)
_WIDTH = 320  # pixels of the longer side
_RATE = 12.0  # frames a second that are looked at, at least
_MOST_STRIDE = 4
_BORDER = 2  # pixels
_LOOKING = PluginChoice(name="flow", segmentation_size=128)
"""Cheaper than `csrt` by far, and uncorrected it follows longer; history/pages/many-videos.md has figures."""


def tracker_for_looking(own: PluginChoice) -> PluginChoice:
    """The mask tracker of the preview: precomputed masks cost nothing; else a fast tracker."""
    return own if own.name == "precomputed" else _LOOKING


def stride_of(fps: float | None) -> int:
    """Step of the preview in frames; 2 if the frame rate is unknown."""
    return 2 if fps is None else min(max(int(fps / _RATE), 1), _MOST_STRIDE)


def preview_video(
    source: FrameSource, prompt: Prompt | None, tracker: PluginChoice, allowed: Sequence[range]
) -> list[Sighting]:
    """The object in the frames up to the last one that may be cut at.

    Args:
        source: The frames.
        prompt: The object in the first of them; None if the tracker knows.
        tracker: See `tracker_for_looking`.
        allowed: Allowed positions of cuts; masks are kept only there.

    Raises:
        PluginError: If the tracker cannot start.
    """
    stride, last = stride_of(source.fps), max((window.stop for window in allowed), default=0)
    whole = tracker.name == "precomputed"
    found: list[Sighting] = []
    looking: PromptedTracker | None = None
    for position, frame in enumerate(source):
        if position >= last:
            break
        if not isinstance(frame, Frame) or (looking is not None and position % stride):
            continue
        small = frame if whole else _small(frame)
        try:
            if looking is None:
                looking = PromptedTracker(tracker, _scale_prompt(prompt, frame, small))
                estimate = looking.start(small)
            else:
                estimate = looking.step(small)
        except PluginError as error:
            if looking is None or not found:
                raise
            _log.warning("The preview ends at %s: %s", frame.label, error)
            break
        mask = estimate.found
        inside = any(position in window for window in allowed)
        found.append(_sighting(position, mask, estimate.score, keep=inside))
    return found


def full_size(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask of the preview at the frames' size ``(height, width)``."""
    if mask.shape == size:
        return mask
    wide = cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(wide >= 0.5, dtype=np.bool_)


def _sighting(position: int, mask: NDArray[np.bool_] | None, score: float, keep: bool) -> Sighting:
    if mask is None:
        return Sighting(position, 0, False, 0.0)
    inner = mask[_BORDER:-_BORDER, _BORDER:-_BORDER]
    touches = bool(np.count_nonzero(inner) < np.count_nonzero(mask))
    return Sighting(position, int(np.count_nonzero(mask)), touches, float(score), mask if keep else None)


def _small(frame: Frame) -> Frame:
    height, width = frame.size
    factor = min(_WIDTH / max(height, width), 1.0)
    if factor == 1.0:
        return frame
    size = max(round(factor * width), 1), max(round(factor * height), 1)
    return replace(frame, image=np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)))


def _scale_prompt(prompt: Prompt | None, frame: Frame, small: Frame) -> Prompt | None:
    if prompt is None or frame.size == small.size:
        return prompt
    x, y = small.size[1] / frame.size[1], small.size[0] / frame.size[0]
    box = (prompt.box[0] * x, prompt.box[1] * y, prompt.box[2] * x, prompt.box[3] * y)
    mask = None
    if prompt.mask is not None:
        shrunk = cv2.resize(prompt.mask.astype(np.float32), small.size[::-1], interpolation=cv2.INTER_AREA)
        mask = np.asarray(shrunk >= 0.5, dtype=np.bool_)
    return Prompt(box, mask if mask is not None and mask.any() else None)
