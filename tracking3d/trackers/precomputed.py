"""Mask tracker ``precomputed``: masks from another program."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.mask_files import ImageMasks, MaskFiles, UnreadableMaskError, natural_key, open_masks
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import ColourSegmentation
from tracking3d.trackers.vot_regions import RegionMasks

_ASPECT_TOLERANCE = 0.02


class PrecomputedMasks:
    """Mask tracker ``precomputed``: a folder, a video or a numpy file with one mask a frame, gaps allowed.

    See `match_masks` for which mask belongs to which frame. A mask of another size is scaled to the frame's.
    """

    class Options(Options):
        """Options of ``precomputed``."""

        path: str = Field(
            description=(
                "Folder of images, video, .npz or .npy file; values above half or above 0 are the object. "
                "Or a COCO JSON or VOT text file."
            )
        )
        object: int | None = Field(
            None,
            ge=0,
            description="The object if files hold several: its palette index, or COCO's number.",
        )

    def __init__(self, masks: MaskFiles) -> None:
        self._masks = masks
        self._find: Callable[[Frame], int | None] | None = None

    @classmethod
    def from_options(cls, options: BaseModel) -> Self | PrecomputedBoxes:
        """Open the masks at ``options.path``, or boxes; raises `InputError` if there are none."""
        if not isinstance(options, PrecomputedMasks.Options):
            raise PluginError("The tracker precomputed was given the options of another tracker.")
        masks = open_masks(Path(options.path), options.object)
        if isinstance(masks, RegionMasks) and masks.has_rectangles:
            return PrecomputedBoxes(masks)
        return cls(masks)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """The first frame's mask; the prompt's if there is none.

        Raises:
            InputError: If a mask's proportions are not the frame's.
        """
        self._match(frame)
        if isinstance(self._masks, ImageMasks):  # headers are cheap: complain now, not an hour into the run
            for position in range(len(self._masks.names)):
                if shape := self._masks.shape(position):
                    self._check(shape, position, frame)
        estimate = self.step(frame)
        if estimate.mask is None and prompt.mask is not None:
            return MaskEstimate(prompt.mask.astype(np.float32), reason="the mask given with the first frame")
        return estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """The frame's mask, or an estimate without a mask if it is missing.

        Raises:
            InputError: If the mask's proportions are not the frame's.
        """
        if self._find is None:
            raise PluginError("The tracker precomputed must be started with init before it tracks a frame.")
        position = self._find(frame)
        if position is None:
            return MaskEstimate(None, 0.0, "there is no mask for this frame")
        try:
            mask = self._masks.read(position)
        except UnreadableMaskError as error:
            return MaskEstimate(None, 0.0, str(error))
        if mask is None:
            return MaskEstimate(None, 0.0, "there is no mask for this frame")
        if not mask.any():
            return MaskEstimate(None, 0.0, f"the mask {self._masks.label(position)} is empty")
        self._check(mask.shape, position, frame)
        occluder = self._masks.read_occluder(position) if isinstance(self._masks, ImageMasks) else None
        if occluder is not None:
            occluder = _resize(occluder, frame.size) > 0
        return MaskEstimate(_resize(mask, frame.size).astype(np.float32), occluder=occluder)

    def state(self) -> None:
        """Nothing: every mask is looked up by its frame."""

    def restore(self, frame: Frame, prompt: Prompt, state: None) -> None:
        """Decide on the first frame again how masks belong to frames."""
        self._match(frame)

    def _match(self, first: Frame) -> None:
        self._find = match_masks(self._masks.names, first)
        if isinstance(self._masks, RegionMasks):
            self._masks.in_frames(first.size)

    def _check(self, shape: tuple[int, ...], position: int, frame: Frame) -> None:
        (height, width), (frame_height, frame_width) = shape, frame.size
        if abs(width * frame_height / (height * frame_width) - 1) > _ASPECT_TOLERANCE:
            raise InputError(
                f"The mask {self._masks.label(position)} is {width}x{height} pixels but "
                f"{frame.name or f'frame {frame.index}'} is {frame_width}x{frame_height}; "
                "give masks of the frames' size or proportions."
            )


def match_masks(names: Sequence[str], first: Frame) -> Callable[[Frame], int | None]:
    """Decide on the first frame how masks belong to frames.

    1. By name without suffix, if the first frame has a mask of its name: ``000012.png`` or ``12.png`` is
       the mask of ``000012.jpg``.
    2. Else by the number in the mask's name: the frame's index counted from 0; or, if no mask is numbered
       0, the number in the frame's own name.
    3. Else by order: mask n belongs to frame n of the source.

    Args:
        names: The masks' names, in order; empty if they have none.
        first: The first frame.

    Returns:
        A function from a frame to the position of its mask, or to None.
    """
    by_name = {natural_key(name): position for position, name in enumerate(names)}
    if natural_key(_stem(first)) in by_name:
        return lambda frame: by_name.get(natural_key(_stem(frame)))
    by_number = {number: position for position, number in enumerate(_numbers(names))}
    if 0 in by_number or (by_number and _last_number(first) is None):
        return lambda frame: by_number.get(frame.index)
    if by_number:
        return lambda frame: by_number.get(_last_number(frame) or 0)
    return lambda frame: frame.index if not names or frame.index < len(names) else None


def _stem(frame: Frame) -> str:
    return Path(frame.name).stem


def _last_number(frame: Frame) -> int | None:
    digits = re.findall(r"\d+", _stem(frame))
    return int(digits[-1]) if digits else None


def _numbers(names: Sequence[str]) -> list[int]:
    """The number that distinguishes the names, the last one; empty if there is none."""
    found = [[int(digits) for digits in re.findall(r"\d+", name)] for name in names]
    for place in range(1, min(map(len, found), default=0) + 1):
        numbers = [row[-place] for row in found]
        if len(set(numbers)) == len(numbers):
            return numbers
    return []


def _resize(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.uint8]:
    plain = mask.astype(np.uint8)
    return plain if mask.shape == size else cv2.resize(plain, size[::-1], interpolation=cv2.INTER_NEAREST)


_CUES = Cues(outline=0.0, background=0.0, novelty=0.0)  # the box does their work, as in the tracker csrt


class PrecomputedBoxes:
    """What the tracker ``precomputed`` is if its file holds boxes: the segmentation of ``csrt``, the box given.

    Args:
        regions: The boxes; line n is frame n.
    """

    def __init__(self, regions: RegionMasks) -> None:
        self._regions = regions
        self._segmentation: ColourSegmentation | None = None

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """The mask in the first frame's box; the prompt's mask if there is one.

        Raises:
            InputError: If that box lies outside the frame.
        """
        box = self._regions.box(frame.index) or prompt.box
        if clip_box(box, frame.image.shape) is None:
            raise InputError(
                f"The box in {self._regions.label(frame.index)} lies outside {frame.label}; boxes are "
                "x, y, width and height in its pixels."
            )
        self._segmentation = ColourSegmentation(frame.image, box, prompt.mask, cues=_CUES)
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """The mask in the frame's box; without a box, what the segmentation finds by itself, not to be relied on."""
        if self._segmentation is None:
            raise PluginError("The tracker precomputed must be started with init before it tracks a frame.")
        box = self._regions.box(frame.index)
        estimate = self._segmentation.step(frame.image, box)
        if box is None and estimate.mask is not None:
            return MaskEstimate(
                np.asarray(estimate.mask, np.float32), estimate.score / 2, "there is no box for this frame"
            )
        return estimate
