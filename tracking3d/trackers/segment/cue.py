"""The network as a cue of the mask that flow carries, prompted with a box that remembers the object's extent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image
from tracking3d.geometry.camera import Window
from tracking3d.trackers.box_trackers import BoxOffset
from tracking3d.trackers.colour_models import GlobalColours
from tracking3d.trackers.crops import paste_mask
from tracking3d.trackers.cues import FrameCrop
from tracking3d.trackers.mask_motion import MaskMotion
from tracking3d.trackers.segment.network import Map, ObjectNetwork, frame_box

_GROWN = 0.16  # of the remembered box, on every side: a new side may turn into view
_BY_MASK = 0.5  # share of the crop with the mask in the log-odds; the crop with the box has the rest
_SHRINKING = 0.1  # of what the remembered box has beyond the mask's, in every frame
_MOST_BEYOND = 0.5  # of the mask's box, on every side


class NetworkCue:
    """Log-odds of the network, see `tracking3d.trackers.segmentation.PixelClassifier`.

    A mask that loses a part of the object loses it for good if the next prompt is its box. So the prompt is a box that
    follows the mask: it grows immediately, and shrinks slowly.

    Args:
        network: The network.
        box: ``(x, y, w, h)``, the object in the first frame.
    """

    def __init__(self, network: ObjectNetwork, box: Box) -> None:
        self._network = network
        self._extent = box
        self._occluder: tuple[Map, Window] | None = None

    def log_odds(
        self, image: Image, present: FrameCrop, motion: MaskMotion, colours: GlobalColours, last: Box
    ) -> tuple[Map, Map]:
        """``(S, S)`` log-odds within [-4, 4] of the object, and of an occluder, in the crop ``present`` of ``image``.

        Args:
            image: ``(H, W, 3)`` RGB.
            present: The crop.
            motion: Where the last mask has moved in it.
            colours: The colours of the object and of its surroundings.
            last: ``(x, y, w, h)``, the box of the last mask.
        """
        carried = ((motion.by_flow + motion.by_similarity) / 2).astype(np.float32)
        if (moved := frame_box(carried, present.window)) is not None:
            remembered = _settle(self._extent, last)
            self._extent = BoxOffset.between(last, remembered).apply(moved)
        prompt = _grow(self._extent, _GROWN)
        by_mask, by_box, occluder = self._network.log_odds(
            image, carried, motion.cue, present.window, colours, prompt
        )
        self._occluder = occluder, present.window
        return (_BY_MASK * by_mask + (1 - _BY_MASK) * by_box).astype(np.float32), occluder

    def take_occluder(self, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """``(H, W)``, what is in front of the object in the frame of ``shape`` that was asked about last.

        None if no frame was asked about since the last call.
        """
        if self._occluder is None:
            return None
        (log_odds, window), self._occluder = self._occluder, None
        return paste_mask(log_odds > 0, window, shape) > 0.5

    def correct(self, box: Box) -> None:
        """Take the box ``(x, y, w, h)`` of a better mask as the object's extent."""
        self._extent = box


def _settle(extent: Box, mask: Box) -> Box:
    """A remembered box after a frame: at least the mask's box, and a little nearer to it."""
    sides = []
    for at, length in ((0, 2), (1, 3)):
        first, last = mask[at], mask[at] + mask[length]
        most = _MOST_BEYOND * mask[length]
        before = min(max(first - extent[at], 0.0), most) * (1 - _SHRINKING)
        after = min(max(extent[at] + extent[length] - last, 0.0), most) * (1 - _SHRINKING)
        sides.append((first - before, last + after))
    (left, right), (top, bottom) = sides
    return left, top, right - left, bottom - top


def _grow(box: Box, share: float) -> Box:
    x, y, width, height = box
    return x - share * width, y - share * height, width * (1 + 2 * share), height * (1 + 2 * share)
