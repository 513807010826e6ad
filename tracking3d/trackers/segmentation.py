"""Temporally consistent colour segmentation of one object: the last mask moved along, colours kept.

GrabCut gives the first mask. From then on every pixel of a crop around the object collects log-odds from
where the last mask has moved to, from global and local colours that are kept, from how the pixel moves, and
from a box tracker's box where there is one; an edge-aware smoother, far cheaper than a graph cut, turns them
into a mask. The box is a *witness*, not the master: the object is segmented anew from it only when the mask
looks lost. Any box tracker will do. Everything is deterministic and causal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image, MaskEstimate
from tracking3d.geometry.camera import Window
from tracking3d.trackers.background import BackgroundMemory
from tracking3d.trackers.colour_models import GlobalColours, Palette, lab
from tracking3d.trackers.confidence import Judgement, outline_margin, signed_distance
from tracking3d.trackers.crops import box_iou, box_of, clip_box, cut, inside_frame, paste
from tracking3d.trackers.first_mask import mask_in_box
from tracking3d.trackers.mask_motion import MaskMotion, follow_mask

_MARGIN = 0.45  # free space around the last box: how far the mask may move or grow in one frame
_AREA_CHANGE = 0.35  # a larger relative change against the moved mask is not believed
_PATIENCE = 3  # doubtful frames in a row before each attempt to begin anew


@dataclass(frozen=True)
class Cues:
    """What a pixel's log-odds are made of: the weights of their parts. 0 switches a part off.

    Attributes:
        prior: Distance to the outline of the moved mask.
        global_colours: Colours of the whole object and its surroundings, remembered.
        local_colours: Colours nearby, one frame ago.
        motion: Whether the pixel moves with the object or with the background.
        witness: Distance beyond the box tracker's box.
        similarity: Whether the prior is also the mask moved by one similarity, besides by dense flow.
        smoother: Whether the edge-aware smoother follows.
    """

    prior: float = 1.5
    global_colours: float = 1.0
    local_colours: float = 1.0
    motion: float = 2.0
    witness: float = 1.0
    change: float = 0.0
    similarity: bool = True
    smoother: bool = True


class ColourSegmentation:
    """Follows one object's mask through a video.

    Args:
        image: ``(H, W, 3)`` uint8 RGB, the first frame.
        box: ``(x, y, w, h)`` in pixels, the object in it.
        mask: ``(H, W)`` bool, the object's first mask; segmented from the box if None.
        size: Side of the working crop in pixels.
        cues: The weights of the evidence.
    """

    def __init__(
        self,
        image: Image,
        box: Box,
        mask: NDArray[np.bool_] | None = None,
        size: int = 224,
        cues: Cues | None = None,
    ) -> None:
        self._size = size
        self._cues = cues or Cues()
        self._image = image
        self._mask = mask_in_box(image, box) if mask is None else mask.astype(np.float32)
        self._velocity = (0, 0)
        self._doubtful_frames = 0
        window = Window.around(box_of(self._mask) or box, _MARGIN, size)
        colours = lab(cut(image, window))
        inside, around = _sides(cut(self._mask, window))
        self._colours = GlobalColours(colours, inside, around)
        self._palette = Palette(colours)
        self._background = BackgroundMemory(image.shape)
        self._background.learn(image, window, around & inside_frame(image.shape, window))
        separation = self._colours.separation(colours, inside, around)
        self._judgement = Judgement(separation, margin=separation)

    @property
    def estimate(self) -> MaskEstimate:
        """The latest frame's mask and score, or no mask and the reason where the object is out of sight."""
        if box_of(self._mask) is None:
            return MaskEstimate(None, 0.0, "the object is out of sight")
        return MaskEstimate(self._mask, self._judgement.score, self._judgement.doubt)

    def correct(self, image: Image, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``image``, the latest frame, and learn from its colours."""
        self._image, self._mask = image, mask.astype(np.float32)
        self._velocity, self._doubtful_frames = (0, 0), 0
        if (box := box_of(mask)) is not None:
            window = Window.around(box, _MARGIN, self._size)
            self._colours.update(lab(cut(image, window)), *_sides(cut(self._mask, window)))

    def step(self, image: Image, witness: Box | None = None) -> MaskEstimate:
        """Segment the next frame.

        Args:
            image: ``(H, W, 3)`` uint8 RGB.
            witness: ``(x, y, w, h)``, a box tracker's opinion, or None where there is none.
        """
        witness = None if witness is None else clip_box(witness, image.shape)
        mask, judgement = self._follow(image, witness)
        self._doubtful_frames = self._doubtful_frames + 1 if judgement.doubt else 0
        if witness is not None and self._doubtful_frames >= _PATIENCE:
            mask, judgement = self._begin_anew(image, witness, mask, judgement)
            self._doubtful_frames = 0
        self._velocity = _shift(box_of(self._mask), box_of(mask))
        self._image, self._mask, self._judgement = image, mask, judgement
        return self.estimate

    def _follow(self, image: Image, witness: Box | None) -> tuple[NDArray[np.float32], Judgement]:
        out_of_sight = np.zeros(image.shape[:2], np.float32), Judgement(0.0, 0.0, believed=False)
        box = box_of(self._mask)
        if box is None:
            return out_of_sight
        before = Window.around(box, _MARGIN, self._size)
        right, down = self._velocity
        window = Window(before.left + right, before.top + down, before.side, self._size)
        last, present = cut(self._image, before), cut(image, window)
        in_frame = inside_frame(image.shape, window)
        cues = self._cues
        motion = follow_mask(_grey(last), _grey(present), cut(self._mask, before), cues.similarity)
        moved = (motion.by_flow + motion.by_similarity > 1.0) & in_frame
        area = int(np.count_nonzero(moved))
        if area < 9:
            return out_of_sight

        colours = lab(present)
        evidence = self._evidence(colours, lab(last), motion, area)
        if cues.change:
            if motion.background is not None:
                self._background.move(_in_frame(motion.background, window, before))
            evidence += cues.change * self._background.change(image, window)
        if witness is not None:
            evidence -= cues.witness * _distance_beyond(witness, window)
        support = np.tanh((evidence + cues.prior * _prior(motion, area)) / 3)
        if cues.smoother:
            support = cv2.ximgproc.fastGlobalSmootherFilter(present, support, 100.0, 12.0)
        mask = _clean((support > 0) & in_frame, moved)
        believed = bool(abs(np.count_nonzero(mask) / area - 1) <= _AREA_CHANGE)
        if not believed:
            mask = moved
        inside, around = _sides(mask)
        around &= in_frame
        separation = self._colours.separation(colours, inside, around)
        if believed:
            self._colours.update(colours, inside, around)
            if cues.change:
                self._background.learn(image, window, around)
        full = paste(mask, window, image.shape)
        agreement = None if witness is None else box_iou(box_of(full) or (0.0, 0.0, 0.0, 0.0), witness)
        return full, Judgement(separation, outline_margin(evidence, mask), agreement, believed)

    def _evidence(
        self, colours: NDArray[np.uint8], last_colours: NDArray[np.uint8], motion: MaskMotion, area: int
    ) -> NDArray[np.float32]:
        cues = self._cues
        evidence = cues.global_colours * self._colours.log_ratio(colours) + cues.motion * motion.cue
        if cues.local_colours == 0:  # half of the time goes into them
            return evidence
        last_labels = cv2.remap(
            self._palette.label(last_colours), motion.source, None, cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        radius = max(round(0.22 * math.sqrt(area)), 1)
        local = self._palette.local_log_ratio(
            self._palette.label(colours), last_labels, motion.by_flow, radius
        )
        return evidence + cues.local_colours * local

    def _begin_anew(
        self, image: Image, witness: Box, mask: NDArray[np.float32], judgement: Judgement
    ) -> tuple[NDArray[np.float32], Judgement]:
        """Segment from the witness's box; keep the old mask unless the new one looks more like the object."""
        fresh = mask_in_box(image, witness)
        window = Window.around(witness, _MARGIN, self._size)
        inside, around = _sides(cut(fresh, window))
        around &= inside_frame(image.shape, window)
        fresh_judgement = Judgement(
            self._colours.separation(lab(cut(image, window)), inside, around), 0.0, judgement.agreement
        )
        if fresh_judgement.separation <= judgement.separation:
            return mask, judgement
        return fresh, fresh_judgement


def _in_frame(matrix, window, before):
    """last frame from present frame"""
    def frame_to_crop(w):
        s = w.scale
        return np.array([[s, 0, (0.5 - w.left) * s - 0.5], [0, s, (0.5 - w.top) * s - 0.5], [0, 0, 1]])
    full = np.vstack([matrix, [0, 0, 1]])
    return (np.linalg.inv(frame_to_crop(before)) @ full @ frame_to_crop(window))[:2]


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def _disc(radius: float) -> NDArray[np.uint8]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(round(radius), 1) + 1,) * 2)


def _sides(mask: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The object's pixels, and those surely beyond its outline."""
    inside = mask > 0.5
    grown = cv2.dilate(inside.astype(np.uint8), _disc(0.05 * math.sqrt(np.count_nonzero(inside))))
    return inside, grown == 0


def _prior(motion: MaskMotion, area: int) -> NDArray[np.float32]:
    distance = signed_distance(motion.by_flow > 0.5) + signed_distance(motion.by_similarity > 0.5)
    return np.clip(distance / np.float32(0.24 * math.sqrt(area)), -4.0, 4.0)


def _distance_beyond(box: Box, window: Window) -> NDArray[np.float32]:
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


def _clean(mask: NDArray[np.bool_], moved: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop specks, components that the moved mask does not support, and pinholes."""
    area = int(np.count_nonzero(moved))
    disc = _disc(0.02 * math.sqrt(area))
    tidy = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)
    tidy = cv2.morphologyEx(tidy, cv2.MORPH_CLOSE, disc)
    count, labels = cv2.connectedComponents(tidy)
    sizes = np.bincount(labels.ravel(), minlength=count)
    supported = np.bincount(labels[moved], minlength=count) > 0.3 * sizes
    supported[0] = False
    kept = supported[labels]
    _, labels = cv2.connectedComponents((~kept).astype(np.uint8), connectivity=4)
    pinhole = np.bincount(labels.ravel()) < 0.02 * area
    pinhole[0] = False
    return kept | pinhole[labels]


def _shift(last: Box | None, present: Box | None) -> tuple[int, int]:
    """Pixels the box's centre moved, at most the box's longer side."""
    if last is None or present is None:
        return 0, 0
    limit = max(last[2:])
    right, down = (present[i] + present[i + 2] / 2 - last[i] - last[i + 2] / 2 for i in (0, 1))
    return round(max(min(right, limit), -limit)), round(max(min(down, limit), -limit))
