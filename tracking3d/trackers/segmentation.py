"""Temporally consistent segmentation of one object: the last mask is propagated, models of colours and background are
kept.

GrabCut gives the first mask. From then on every pixel of a crop around the object collects log-odds from where the last
mask has moved to, from global and local colours that are kept, from how the pixel moves, from whether it has changed
against the background, and from a box tracker's box if there is one; an edge-aware smoother, far cheaper than a graph
cut, turns them into a mask. The box only supports the mask: the object is segmented again from it only if the mask
looks lost. Any box tracker will do. Everything is deterministic and causal.
"""

from __future__ import annotations

import math
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import PluginError
from tracking3d.frames import Box, Image, MaskEstimate
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop, crop_window
from tracking3d.trackers.background import BackgroundMemory
from tracking3d.trackers.colour_models import GlobalColours, Palette, lab
from tracking3d.trackers.confidence import Judgement, outline_margin
from tracking3d.trackers.crops import box_iou, box_of, clip_box, outside, paste_mask
from tracking3d.trackers.cues import Cues, colour_and_motion, decide, distance_beyond
from tracking3d.trackers.first_mask import mask_in_box
from tracking3d.trackers.mask_motion import MaskMotion, follow_mask
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.outline import both_sides, inside_distance, remove_specks, touches_border

SMOOTHER = "ximgproc.fastGlobalSmootherFilter"
"""OpenCV contrib modules that the segmentation needs, see `tracking3d.trackers.opencv_build`."""

_MARGIN = 0.45  # free space around the last box: how far the mask may move or grow in one frame
_AREA_CHANGE = 0.35  # a larger relative change against the moved mask is not trusted
_TOLD, _COLOURED = 2.0, 0.5
"""Mean log-odds of the network, 4 at most, and of the colours, 3 at most, from which a larger mask is trusted: a side
has turned into view at once (chosen)."""
_LEAST_PART = 0.1  # of the usual area; less than this at the frame's border counts as not visible
_LEAST_PIXELS = 9  # of the crop; fewer are no mask
_PATIENCE = 3  # doubtful frames in a row before each attempt to re-initialize
_SLACK = 0.1  # of a box's sides: it may be drawn too small
_SEPARATING = (
    2.0,
    2.7,
)  # median log-ratio of the object's colours, at most 3, from and up to which they are favoured
_FAR = 0.3  # of the root of the area: what is further from the mask is background
_PARTED = 3.0  # pixels by which something moved as the background does rather than with the object, to be it
_STILL, _STILL_PLAIN = 24.0, 4.0
"""Times what a pixel's change counts before a camera that stands still, if a network says what else comes before it:
with the weight of `segment` an unchanged pixel has 6 log-odds, as in a search, and a changed one 12, as the network can
say (measured: 19 synthetic clips, IoU .890; .863 with 6 times and without `_CAME`). And times an unchanged one where
nothing has a texture, and the object may well have the colour of what is behind it (chosen)."""
_CAME = 0.3  # mean change, at most 1, from which a larger mask is trusted before such a camera (chosen)
_PATCH = (5, 5)
_SURELY = -0.4  # mean change in a patch, -0.5 at least, below which it shows the background (chosen)
_TEXTURED = (
    15,
    30,
)  # grey levels, at least, from the darkest to the brightest pixel of a patch of this side (chosen)
_REMEMBERED = 0.95  # of how far pixels have moved with the object, from one frame to the next (chosen)
_ALONG = 3.0  # pixels that a hole has moved with the object, to be its own (chosen: true holes stay below 2)
_MOUTH, _HOLE = 0.03, 0.005
"""Half the width of a gap in the outline that leaves a hole closed, of the root of the area, and the area of a hole, of
the object's, from which on it is looked at (chosen: at a half width of .1 masks of cars take in what lies beside)."""
_ALIKE, _RARE = 6.0, 0.01
"""Levels of Lab within which colours are alike, and share of the surroundings that colours need to be theirs (chosen:
metal parts had .009 at most, and what is seen through a handle or between columns .024 at least)."""
_FOUND_AGAIN = 0.6  # of the first mask's colour separation, for what is found after it was out of sight

_Answer = tuple[NDArray[np.float32], Judgement]


class PixelClassifier(Protocol):
    """Says which pixels of a crop are the object, and which are in front of it."""

    def log_odds(
        self, image: Image, present: FrameCrop, motion: MaskMotion, colours: GlobalColours, last: Box
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """``(S, S)`` log-odds of the object and of an occluder in the crop ``present`` of ``image``.

        ``last`` was the box of the object's last mask.
        """
        ...


class ColourSegmentation:
    """Follows one object's mask through a video.

    Args:
        image: ``(H, W, 3)`` uint8 RGB, the first frame.
        box: ``(x, y, w, h)`` in pixels, the object in it.
        mask: ``(H, W)`` bool, the object's first mask; segmented from the box if None.
        size: Side of the working crop in pixels.
        cues: The weights of the evidence.
        network: A segmentation network as a further cue.

    Raises:
        PluginError: If the OpenCV in use lacks `SMOOTHER`.
    """

    def __init__(
        self,
        image: Image,
        box: Box,
        mask: NDArray[np.bool_] | NDArray[np.float32] | None = None,
        size: int = 224,
        cues: Cues | None = None,
        network: PixelClassifier | None = None,
    ) -> None:
        if why := why_no_contrib(SMOOTHER):
            raise PluginError(f"The colour segmentation cannot be used: {why}.")
        self._size, self._cues, self._network = size, cues or Cues(), network
        self._image = image
        self._mask = mask_in_box(image, box, warns=True) if mask is None else mask.astype(np.float32)
        self._velocity = (0, 0)
        self._doubtful_frames = 0
        self._usual_area = float(np.count_nonzero(self._mask > 0.5))
        view = FrameCrop.of(image, Window.around(box_of(self._mask) or box, _MARGIN, size))
        inside, around = both_sides(crop_window(self._mask, view.window))
        self._colours = GlobalColours(view.lab, inside, around)
        self._palette = Palette(view.lab)
        beside = both_sides(mask)[1] if mask is not None else outside(box, image.shape, _SLACK)
        self._background = BackgroundMemory(image, beside)
        # A window, and how far its pixels have moved with the object rather than with the background so far.
        self._along = view.window, np.zeros((size, size), np.float32)
        self._first_separation = self._colours.separation(view.lab, inside, around)
        self._judgement = Judgement(self._first_separation, margin=self._first_separation)

    @property
    def estimate(self) -> MaskEstimate:
        """The latest frame's mask and score, or no mask and a reason if the object is not visible."""
        if box_of(self._mask) is None:
            return MaskEstimate(None, 0.0, "the object is not visible")
        return MaskEstimate(self._mask, self._judgement.score, self._judgement.doubt)

    def correct(self, image: Image, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``image``, the latest frame, and learn from its colours.

        A mask at the place of the last one moves on as that did; of one elsewhere nothing is known.
        """
        before, box = box_of(self._mask), box_of(mask)
        if before is None or box is None or not box_iou(before, box):
            self._velocity = (0, 0)
        self._image, self._mask, self._doubtful_frames = image, mask.astype(np.float32), 0
        if box is not None:
            view = FrameCrop.of(image, Window.around(box, _MARGIN, self._size))
            self._colours.update(view.lab, *both_sides(crop_window(self._mask, view.window)))
            self._background.forget(mask)

    def skip(self, image: Image, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``image``, the next frame, and learn nothing."""
        self._velocity = _shift(box_of(self._mask), box_of(mask))
        self._image, self._mask = image, mask.astype(np.float32)
        self._background.lose()

    def step(self, image: Image, tracked_box: Box | None = None) -> MaskEstimate:
        """Segment the next frame.

        Args:
            image: ``(H, W, 3)`` uint8 RGB.
            tracked_box: ``(x, y, w, h)``, a box tracker's opinion, or None if there is none.
        """
        tracked_box = None if tracked_box is None else clip_box(tracked_box, image.shape)
        box = box_of(self._mask)
        mask, judgement = self._search(image) if box is None else self._follow(image, box, tracked_box)
        self._doubtful_frames = self._doubtful_frames + 1 if judgement.doubt else 0
        if tracked_box is not None and self._doubtful_frames >= _PATIENCE:
            mask, judgement = self._restart(image, tracked_box, mask, judgement)
            self._doubtful_frames = 0
        self._velocity = _shift(box, box_of(mask))
        self._image, self._mask, self._judgement = image, mask, judgement
        return self.estimate

    def _follow(self, image: Image, box: Box, tracked_box: Box | None) -> _Answer:
        before = Window.around(box, _MARGIN, self._size)
        right, down = self._velocity
        last = FrameCrop.of(self._image, before)
        present = FrameCrop.of(image, Window(before.left + right, before.top + down, before.side, self._size))
        last_mask = crop_window(self._mask, before)
        shift = (before.scale * right, before.scale * down)
        seen = present.in_frame
        motion = follow_mask(last.grey, present.grey, last_mask, self._cues.similarity, shift, seen)
        moved = motion.moved & present.in_frame
        area = np.count_nonzero(moved)
        if area < _LEAST_PIXELS:
            return _out_of_sight(image)

        along = motion.cue + _REMEMBERED * _resample(*self._along, before, motion.source)
        self._along = present.window, along
        cues = self._weigh(present, moved)
        evidence = colour_and_motion(last, present, self._colours, self._palette, motion, cues)
        change = self._change(image, motion, before, present)
        if self._network is not None:
            said, occluder = self._network.log_odds(image, present, motion, self._colours, box)
            evidence += cues.network * said
            if self._background.stands_still:
                textured = _is_textured(present.grey)
                if change[moved].mean() < _SURELY:  # nothing but background, be it plain
                    return _out_of_sight(image)
                moved &= (cv2.blur(change, _PATCH) > _SURELY) | ~textured
                area = np.count_nonzero(moved)
                if area < _LEAST_PART * self._usual_area * present.window.scale**2:
                    return _out_of_sight(image)
                weight = np.where((change < 0) & ~textured, _STILL_PLAIN, _STILL)
                weight[(change > 0) & (occluder > 0)] = 1
                evidence += self._cues.background * (weight - 1) * change
        evidence += self._cues.background * change
        if tracked_box is not None:
            evidence -= self._cues.box * distance_beyond(tracked_box, present.window)
        mask = remove_specks(decide(present, evidence, last_mask, motion, self._cues), moved, motion.cue)

        at_border = touches_border(moved, present.in_frame)
        believed = bool(abs(np.count_nonzero(mask) / area - 1) <= _AREA_CHANGE)
        if not believed and at_border:  # an object that comes or goes changes its area fast: colours decide
            believed = self._separation(present, mask) > self._separation(present, moved)
        if not believed and self._network is not None and np.count_nonzero(mask) > area:
            grown = mask & ~moved
            both = said[grown].mean() / _TOLD, self._colours.log_ratio(present.lab)[grown].mean() / _COLOURED
            came = self._background.stands_still and change[grown].mean() > _CAME
            believed = bool(came or min(both) > 1)
        mask = mask if believed else moved
        if self._network is not None:
            mask = fill_own_holes(mask, present, along, occluder > 0)
        frame_area = np.count_nonzero(mask) / present.window.scale**2
        if at_border and frame_area < _LEAST_PART * self._usual_area:
            return _out_of_sight(image)
        if believed:
            self._usual_area = self._usual_area if at_border else frame_area
            _, around = _sides(mask, present)
            self._colours.update(present.lab, mask, around)
            far = inside_distance(mask) < -_FAR * math.sqrt(max(int(np.count_nonzero(mask)), 1))
            self._learn_background(image, present, around, np.where(far, 1, -motion.cue / _PARTED))
        full = paste_mask(mask, present.window, image.shape)
        agreement = (
            None if tracked_box is None else box_iou(box_of(full) or (0.0, 0.0, 0.0, 0.0), tracked_box)
        )
        separation, margin = self._separation(present, mask), outline_margin(evidence, mask)
        return full, Judgement(separation, margin, agreement, believed)

    def _change(
        self, image: Image, motion: MaskMotion, before: Window, present: FrameCrop
    ) -> NDArray[np.float32]:
        """``(S, S)`` whether pixels have changed against the background, see `BackgroundMemory.change`."""
        if not self._cues.background:
            return np.zeros_like(motion.cue)
        if motion.background is None:
            self._background.lose()
        else:
            # Without a network what comes before a still background may as well be a hand.
            images = None if self._network is None else (self._image, image)
            self._background.move(motion.background, before, present.window, images)
        return self._background.change(image, present.window)

    def _weigh(self, present: FrameCrop, moved: NDArray[np.bool_]) -> Cues:
        """The cues' weights in a frame: a network knows less than colours that are the object's alone."""
        if self._network is None:
            return self._cues
        median = float(np.median(self._colours.log_ratio(present.lab)[moved]))
        none, full = _SEPARATING
        return self._cues.favour_colours(min(max((median - none) / (full - none), 0.0), 1.0))

    def _search(self, image: Image) -> _Answer:
        """The mask of what has the object's colours, if anything has, after the object was out of sight."""
        self._background.lose()
        unchanged = self._background.unchanged_score(image) if self._cues.background else None
        found = find_by_colours(image, self._colours, self._usual_area, _MARGIN, self._size, unchanged)
        if found is None or found[2] < _FOUND_AGAIN * self._first_separation:
            return _out_of_sight(image)
        mask, window, separation = found
        return paste_mask(mask, window, image.shape), Judgement(separation, margin=separation)

    def _restart(
        self, image: Image, tracked_box: Box, mask: NDArray[np.float32], judgement: Judgement
    ) -> _Answer:
        """Segment from the box tracker's box; keep the old mask unless the new one looks more like the object."""
        fresh = mask_in_box(image, tracked_box)
        view = FrameCrop.of(image, Window.around(tracked_box, _MARGIN, self._size))
        separation = self._separation(view, crop_window(fresh, view.window))
        in_sight = box_of(mask) is not None
        if separation <= (judgement.separation if in_sight else _FOUND_AGAIN * self._first_separation):
            return mask, judgement
        self._background.forget(fresh > 0.5)
        return fresh, Judgement(separation, 0.0, judgement.agreement)

    def _learn_background(
        self, image: Image, view: FrameCrop, around: NDArray[np.bool_], proof: NDArray
    ) -> None:
        if self._cues.background:
            self._background.learn(image, view.window, around, proof.astype(np.float32))

    def _separation(self, view: FrameCrop, mask: NDArray) -> float:
        return self._colours.separation(view.lab, *_sides(mask, view))


def _resample(
    window: Window, values: NDArray[np.float32], last: Window, source: NDArray[np.float32]
) -> NDArray[np.float32]:
    """``(S, S)`` the values of a window at the pixels ``source`` ``(S, S, 2)`` of the window ``last``; 0 beyond."""
    matrix = np.linalg.inv(window.to_frame) @ last.to_frame
    return cv2.remap(values, cv2.transform(source, matrix[:2]), None, cv2.INTER_LINEAR)


def fill_own_holes(
    mask: NDArray[np.bool_], present: FrameCrop, along: NDArray[np.float32], occluder: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """The mask with the holes that are the object itself, as a hinge or a socket of metal is.

    What is seen through a hole has colours of the surroundings, or does not move with the object. Nor is it in front of
    the object; and what is in front of it, like a hand, comes from beyond its outline.

    Args:
        mask: ``(S, S)`` the object.
        present: The crop.
        along: ``(S, S)`` pixels by which each has moved with the object rather than with the background so far.
        occluder: ``(S, S)`` what seems to be in front of the object.
    """
    area = int(np.count_nonzero(mask))
    side = 2 * max(round(_MOUTH * math.sqrt(area)), 1) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, disc)
    outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = cv2.drawContours(np.zeros_like(closed), outlines, -1, 1, cv2.FILLED)
    holes = (whole > 0) & ~mask & present.in_frame
    _, part, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=4)
    large = np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] > _HOLE * area) + 1
    if not large.size or not (around := both_sides(whole)[1] & present.in_frame).any():
        return mask
    colours = cv2.GaussianBlur(present.lab, (0, 0), 1.0).astype(np.float32)
    surroundings = colours[around][::7]
    for hole in (part == number for number in large):
        if along[hole].mean() < (_ALONG if occluder[hole].mean() < 0.5 else 0):
            continue
        seen = colours[hole]
        seen = seen[:: len(seen) // 50 + 1]
        alike = np.linalg.norm(seen[:, None] - surroundings, axis=-1) < _ALIKE
        if np.median(alike.mean(1)) < _RARE:
            mask = mask | hole
    return mask


def _is_textured(grey: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """``(S, S)``: where a crop has a texture, noise aside."""
    side, contrast = _TEXTURED
    smooth, patch = cv2.blur(grey, (3, 3)), np.ones((side, side), np.uint8)
    return cv2.subtract(cv2.dilate(smooth, patch), cv2.erode(smooth, patch)) > contrast


def _sides(mask: NDArray, view: FrameCrop) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The two sides of a crop's mask; what lies beyond the frame is no background."""
    inside, around = both_sides(mask)
    return inside, around & view.in_frame


def _out_of_sight(image: Image) -> _Answer:
    return np.zeros(image.shape[:2], np.float32), Judgement(0.0, 0.0, believed=False)


def _shift(last: Box | None, present: Box | None) -> tuple[int, int]:
    """Pixels the box's centre moved, at most the box's longer side."""
    if last is None or present is None:
        return 0, 0
    limit = max(last[2:])
    right, down = (present[i] + present[i + 2] / 2 - last[i] - last[i + 2] / 2 for i in (0, 1))
    return round(max(min(right, limit), -limit)), round(max(min(down, limit), -limit))


_OVERVIEW = 160  # longer side in pixels of the image that is searched
_UNCHANGED = 6.0  # log-odds, as many as colours can say, that what was there without the object is not it
_LEAST_AREA, _MOST_AREA = (0.1, 2.5)  # of the object's usual area; while it comes in, only a part is seen


def find_by_colours(
    image: Image,
    colours: GlobalColours,
    area: float,
    margin: float,
    size: int,
    unchanged: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.bool_], Window, float] | None:
    """Segment what looks most like the object.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        colours: What is known of the object.
        area: Its usual area in pixels of the frame.
        margin: Free space around it in the crop, relative to its size.
        size: Side of the crop in pixels.
        unchanged: ``(H, W)`` in [0, 1] how surely a pixel is what was seen of the background there, or None.

    Returns:
        The mask ``(size, size)`` in a window, the window, and how well its colours tell it from its surroundings,
        in [-1, 1]; None if nothing of a possible size has such colours.
    """
    scale = min(_OVERVIEW / max(image.shape[:2]), 1.0)
    overview = lab(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    likeness = np.tanh(colours.rarity(overview, overview))
    known = np.zeros(image.shape[:2], np.float32) if unchanged is None else unchanged
    known_overview = cv2.resize(known, overview.shape[1::-1], interpolation=cv2.INTER_AREA)
    likeness = np.minimum(likeness, 1 - 2 * known_overview)
    blurred = cv2.GaussianBlur(likeness, (0, 0), max(math.sqrt(area) * scale, 3.0) / 3)
    row, column = np.unravel_index(int(np.argmax(blurred)), blurred.shape)
    side = 1.3 * math.sqrt(area)
    left, top = ((at + 0.5) / scale - side / 2 for at in (column, row))
    window = Window.around((left, top, side, side), margin, size)

    crop = FrameCrop.of(image, window)
    rows, columns = np.mgrid[:size, :size] + 0.5 - size / 2
    evidence = 2 * colours.rarity(crop.lab, overview) + 1 - np.hypot(rows, columns) / (0.3 * size)
    evidence -= _UNCHANGED * crop_window(known, window)
    support = np.tanh(evidence / 3).astype(np.float32)
    smooth = cv2.ximgproc.fastGlobalSmootherFilter(crop.image, support, 100.0, 12.0)
    found = (smooth > 0) & crop.in_frame
    mask = _largest(remove_specks(found, found))
    if not _LEAST_AREA * area <= np.count_nonzero(mask) / window.scale**2 <= _MOST_AREA * area:
        return None
    inside, around = both_sides(mask)
    return mask, window, colours.separation(crop.lab, inside, around & crop.in_frame)


def _largest(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    stats[0, cv2.CC_STAT_AREA] = 0
    largest = int(np.argmax(stats[:, cv2.CC_STAT_AREA]))
    return mask & (labels == largest)
