"""Mask tracker ``segment``: the network of the package, flow that carries the mask, colours that remember."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import PluginError
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop
from tracking3d.trackers.box_trackers import BoxOffset, Lookahead
from tracking3d.trackers.colour_models import GlobalColours
from tracking3d.trackers.crops import box_of, check_box_in_frame, paste_mask
from tracking3d.trackers.cues import Cues, weight
from tracking3d.trackers.first_mask import mask_with_network
from tracking3d.trackers.mask_motion import MaskMotion
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segment.network import Map, ObjectNetwork, beside_mask, frame_box
from tracking3d.trackers.segmentation import SMOOTHER, ColourSegmentation

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


_CUES = Cues(
    # The network knows outlines; the last one would keep a side out that turns into view, and gaps closed.
    prior=0.5, outline=0.0, novelty=0.0,
    network=3.0, global_colours=0.5, local_colours=0.5, motion=1.0, background=0.5,
)  # fmt: skip


class SegmentTracker:
    """Mask tracker ``segment``.

    In every frame the network sees a crop twice: with the last mask, carried by flow, and colours and motion of the
    object; and with nothing but a box around it. Its log-odds join those of the tracker ``flow``. Its second map says
    what is in front of the object.
    """

    class Options(Options):
        """Options of ``segment``."""

        segmentation_size: int = Field(
            224, ge=64, le=1024, description="Side of the segmentation's crop in pixels."
        )
        network: float = weight(_CUES.network, "Weight of the network's log-odds.")
        colours: float = weight(
            _CUES.global_colours,
            "Weight of the object's and background's colours, of the whole object and nearby.",
        )
        motion: float = weight(_CUES.motion, "Weight of motion consistent with the object.")
        background: float = weight(_CUES.background, "Weight of differences from the learnt background.")
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")

    def __init__(self, options: SegmentTracker.Options) -> None:
        self._options = options
        self._network = ObjectNetwork(options.threads)
        self._state: _TrackerState | None = None
        self._lookahead = Lookahead[tuple[_TrackerState, MaskEstimate]]()

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from its validated options."""
        if not isinstance(options, SegmentTracker.Options):
            raise PluginError("The tracker segment was given the options of another tracker.")
        return cls(options)

    @classmethod
    def why_unavailable(cls) -> str:
        """What the OpenCV in use lacks for this tracker; empty if it lacks nothing."""
        return why_no_contrib(SMOOTHER)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the prompt's mask is the first estimate, else the box is segmented."""
        check_box_in_frame(prompt.box, frame)
        options = self._options
        cues = replace(
            _CUES,
            network=options.network,
            global_colours=options.colours,
            local_colours=options.colours,
            motion=options.motion,
            background=options.background,
        )
        likely, occluder = self._network.segment_box(frame.image, prompt.box)
        mask = prompt.mask
        if mask is None:
            mask = mask_with_network(frame.image, prompt.box, likely) > 0.5
        cue = NetworkCue(self._network, prompt.box)
        segmentation = ColourSegmentation(frame.image, prompt.box, mask, options.segmentation_size, cues, cue)
        self._lookahead.discard()
        self._state = _TrackerState(segmentation, cue)
        return _with_occluder(segmentation.estimate, occluder > 0.5)

    def step(self, frame: Frame) -> MaskEstimate:
        """Estimate the mask in the next frame."""
        if self._state is None:
            raise PluginError("The tracker segment must be started with init before it tracks a frame.")
        self._state, estimate = self._lookahead.result(frame.image, partial(_step, self._state, frame.image))
        return estimate

    def announce(self, frame: Frame) -> None:
        """Track the next frame in another thread, on a copy of all that is known; a correction discards it."""
        if self._state is not None:
            self._lookahead.begin(frame.image, partial(_step_copy, self._state, frame.image))

    def skip(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in the next frame."""
        if self._state is not None:
            self._lookahead.discard()
            self._state.segmentation.skip(frame.image, mask)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Continue from ``mask`` ``(H, W)`` in ``frame``."""
        if (box := box_of(mask)) is not None and self._state is not None:
            self._lookahead.discard()
            self._state.segmentation.correct(frame.image, mask)
            self._state.cue.correct(box)


@dataclass(frozen=True, eq=False)
class _TrackerState:
    """All that changes from frame to frame; both parts change in place."""

    segmentation: ColourSegmentation
    cue: NetworkCue


def _step(state: _TrackerState, image: Image) -> tuple[_TrackerState, MaskEstimate]:
    estimate = state.segmentation.step(image)
    return state, _with_occluder(estimate, state.cue.take_occluder(image.shape))


def _step_copy(state: _TrackerState, image: Image) -> tuple[_TrackerState, MaskEstimate]:
    return _step(copy.deepcopy(state), image)


def _with_occluder(estimate: MaskEstimate, occluder: NDArray[np.bool_] | None) -> MaskEstimate:
    if occluder is None or estimate.binary is None:
        return estimate
    return replace(estimate, occluder=beside_mask(occluder, estimate.binary))
