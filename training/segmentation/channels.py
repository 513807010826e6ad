"""The input channels that a tracker can offer, made by the product's own code on an imperfect past."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.trackers.colour_models import GlobalColours, lab
from tracking3d.trackers.mask_motion import follow_mask
from tracking3d.trackers.outline import both_sides

Image = NDArray[np.uint8]
Map = NDArray[np.float32]

LOG_LIMIT = 3.0
"""Colour log-odds are clipped here."""

CUE_LIMIT = 2.0
"""The motion cue is clipped here."""


@dataclass(frozen=True, eq=False)
class Past:
    """What a tracker has seen of one object before the present frame.

    Attributes:
        first: ``(S, S, 3)`` RGB, a frame from long ago.
        first_mask: ``(S, S)`` in [0, 1], its mask then.
        last: ``(S, S, 3)`` RGB, the last frame.
        last_mask: ``(S, S)`` in [0, 1], its mask in it.
    """

    first: Image
    first_mask: Map
    last: Image
    last_mask: Map


def channels(past: Past, present: Image) -> tuple[Map, Map, Map]:
    """The carried mask in [0, 1], the colours' log-odds and the motion cue, ``(S, S)`` each."""
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (past.last, present)]
    motion = follow_mask(grey[0], grey[1], past.last_mask)
    first, last = lab(past.first), lab(past.last)
    colours = GlobalColours(first, *both_sides(past.first_mask), rate=0.3)
    colours.update(last, *both_sides(past.last_mask))
    carried = (motion.by_flow + motion.by_similarity) / 2
    return carried, colours.log_ratio(lab(present)), motion.cue
