"""The cues of a mask and their combination, in the pixels of one square crop."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tracking3d.frames import Box
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop
from tracking3d.trackers.colour_models import GlobalColours, Palette
from tracking3d.trackers.mask_motion import MaskMotion
from tracking3d.trackers.outline import prior, shift_to

_NEIGHBOURHOOD = 0.22  # radius within which local colours count, relative to the square root of the area
_FAVOURED = 3.0
_SMOOTHNESS, _EDGES = 100.0, 12.0  # lambda and sigma of the fast global smoother


@dataclass(frozen=True)
class Cues:
    """The weights of what a pixel's log-odds are made of; 0 or False switches a cue off."""

    prior: float = 1.5  # distance to the outline of the moved mask
    # weight in the prior of the last outline, shifted only; the mask moved by flow has weight 1
    outline: float = 2.0
    similarity: bool = True  # whether the mask moved by one similarity has weight 1 in the prior, too
    global_colours: float = 1.0  # colours of the whole object and of its surroundings, remembered
    local_colours: float = 1.0  # colours nearby, one frame ago
    motion: float = 2.0  # whether the pixel moves with the object or with the background
    background: float = 1.0  # whether the pixel has changed against what was seen there before
    # for the object, within the outline, where nothing else is known: it may be a new side
    novelty: float = 2.0
    box: float = 1.0  # distance beyond the box tracker's box
    network: float = 0.0  # log-odds of a segmentation network, if there is one
    smoother: bool = True  # whether the edge-aware smoother follows

    def favour_colours(self, share: float) -> Self:
        """The weights where colours tell the object from its surroundings: they count more, a network less.

        Args:
            share: How far they do, in [0, 1]; at 1 colours have three times their weight, and the network a third.
        """
        factor = _FAVOURED**share
        return replace(
            self,
            network=self.network / factor,
            global_colours=self.global_colours * factor,
            local_colours=self.local_colours * factor,
        )


def weight(default: float, description: str) -> Any:
    """The field of a cue's weight in the options of a tracker."""
    return Field(default, ge=0, le=100, description=description)


def colour_and_motion(
    last: FrameCrop,
    present: FrameCrop,
    colours: GlobalColours,
    palette: Palette,
    motion: MaskMotion,
    cues: Cues,
) -> NDArray[np.float32]:
    """``(S, S)`` log-odds of the object by how pixels look and move."""
    evidence = cues.global_colours * colours.log_ratio(present.lab) + cues.motion * motion.cue
    if cues.local_colours == 0:  # they take a good part of the time
        return evidence
    last_labels = cv2.remap(
        palette.label(last.lab), motion.source, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
    )
    radius = max(round(_NEIGHBOURHOOD * math.sqrt(np.count_nonzero(motion.moved))), 1)
    labels = palette.label(present.lab)
    return evidence + cues.local_colours * palette.local_log_ratio(
        labels, last_labels, motion.by_flow, radius
    )


def distance_beyond(box: Box, window: Window) -> NDArray[np.float32]:
    """``(S, S)``: distance outside ``box``, 1 at 15 % of its sides, at most 2."""
    centres = (np.arange(window.size, dtype=np.float32) + 0.5) / window.scale
    across, down = (
        np.maximum(np.maximum(start - at, at - start - length), 0) / (0.15 * length)
        for at, start, length in (
            (window.left + centres, box[0], box[2]),
            (window.top + centres, box[1], box[3]),
        )
    )
    return np.minimum(np.hypot(across, down[:, None]), 2.0).astype(np.float32)


def decide(
    present: FrameCrop,
    evidence: NDArray[np.float32],
    last_mask: NDArray[np.float32],
    motion: MaskMotion,
    cues: Cues,
) -> NDArray[np.bool_]:
    """``(S, S)``: the object by evidence and prior, smoothed along the edges of the image.

    Args:
        present: The present frame.
        evidence: ``(S, S)`` log-odds by everything but the prior.
        last_mask: ``(S, S)`` in [0, 1], in the last crop.
        motion: Where it has moved.
        cues: The weights.
    """
    opinions = [(1.0, motion.by_flow)] + [(1.0, motion.by_similarity)] * cues.similarity
    if cues.outline or cues.novelty:
        outline = shift_to(last_mask, np.tanh(evidence / 3))
        opinions += [(cues.outline, outline)] * (cues.outline > 0)
        evidence = evidence + cues.novelty * (outline > 0.5) * (1 - np.tanh(np.abs(evidence)))
    log_odds = evidence + cues.prior * prior(opinions, int(np.count_nonzero(motion.moved)))
    support = np.tanh(log_odds / 3).astype(np.float32)
    if cues.smoother:
        support = cv2.ximgproc.fastGlobalSmootherFilter(present.image, support, _SMOOTHNESS, _EDGES)
    return (support > 0) & present.in_frame
