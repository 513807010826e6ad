"""The mask that a frame is answered with: what the image shows between the silhouette and the initial mask."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import MaskSource
from tracking3d.estimation.observation import Observation
from tracking3d.evidence import (
    Colours,
    along_edges,
    as_lab,
    in_question,
    log_odds,
    pasted,
    pixel_features,
    tidied,
)
from tracking3d.evidence.taking_in import taken_in, unlike_surroundings, vouched
from tracking3d.geometry.camera import Window
from tracking3d.trackers.crops import cut, inside_frame

_IN_QUESTION = 0.5
"""See `tracking3d.evidence.in_question`: where both outlines nearly agree, as those of exact masks do, nothing is
missing that motion would have to tell."""
_FINER = 2
"""Pixels of the evidence for each of the window, as of its image."""


@dataclass(frozen=True, eq=False)
class WeighedMask:
    """The mask that a frame is answered with.

    Attributes:
        mask: ``(H, W)``.
        source: Where it comes from.
        probability: ``(H, W)`` of the object: the mask is where it is above a half. None where nothing was weighed.
        moving: Share of the mask by which it differs from the initial one where motion says so.
    """

    mask: NDArray[np.bool_]
    source: MaskSource
    probability: NDArray[np.float32] | None = None
    moving: float = 0.0


def answer_mask(
    rendered: NDArray[np.bool_],
    initial: NDArray[np.bool_] | None,
    observation: Observation,
    confidence: float,
    colours: Colours | None,
    moving: Callable[[], NDArray[np.float32] | None] | None = None,
) -> WeighedMask:
    """The mask that the evidence is for.

    Args:
        rendered: ``(H, W)`` the silhouette at the frame's pose.
        initial: ``(H, W)`` the mask tracker's, or None.
        observation: The frame.
        confidence: Of the pose.
        colours: What earlier frames showed, or None.
        moving: Gives what moves as the object does in the window of `finer`, ``(S, S)``, or None where that is not
            known; asked where the image has to be.
    """
    if initial is None:
        return WeighedMask(rendered, MaskSource.RENDERED)
    window, image = finer(observation)
    lab, own, drawn = as_lab(image), seen_through(initial, window), seen_through(rendered, window)
    sources = pixel_features(lab, own, drawn, confidence, colours)
    odds, asked = log_odds(sources), in_question(sources)
    told = moving() if moving is not None and asked >= _IN_QUESTION else None
    if told is not None:
        odds = taken_in(odds, own, drawn, told, unlike_surroundings(lab, own | drawn))
    support = tidied(along_edges(image, odds, asked))
    support[~inside_frame(initial.shape, window)] = -1
    share = 0.0 if told is None else vouched(support > 0, own, told)
    # The window is the initial mask's: beyond it the silhouette alone says where the object is.
    full = pasted(support, window, np.where(rendered, 1.0, -1.0).astype(np.float32))
    mask = full > 0
    if not mask.any():  # a mask of nothing says that the evidence is for neither
        return WeighedMask(initial, MaskSource.INITIAL)
    return WeighedMask(mask, MaskSource.WEIGHED, 0.5 + 0.5 * full, share)


def learnt(colours: Colours | None, observation: Observation, mask: NDArray[np.bool_]) -> Colours | None:
    """What is known of the colours after a frame with ``mask`` ``(H, W)``."""
    window, image = finer(observation)
    return Colours.of(as_lab(image), seen_through(mask, window), colours)


def finer(observation: Observation) -> tuple[Window, NDArray[np.uint8]]:
    """The window in the pixels of the evidence ``S``, and its image ``(S, S, 3)`` RGB."""
    window = replace(observation.window, size=_FINER * observation.window.size)
    image = (255 * observation.image.permute(1, 2, 0)).round().clamp(0, 255).cpu().numpy()
    return window, np.ascontiguousarray(image.astype(np.uint8))


def seen_through(mask: NDArray[np.bool_], window: Window) -> NDArray[np.bool_]:
    """``(S, S)`` what a window shows of a mask ``(H, W)``."""
    # What is beyond the frame is not the object, although `cut` repeats the border.
    seen = cut(mask.astype(np.float32), window) > 0.5
    return np.asarray(seen & inside_frame(mask.shape, window))
