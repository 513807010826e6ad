"""What the D3S project writes: mask images counted from 1, or a text file with a region a frame."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tracking3d.errors import InputError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.mask_files import UnreadableMaskError, open_masks
from tracking3d.trackers.protocol import MaskTracker
from tracking3d.trackers.region_files import read_regions
from tracking3d.trackers.region_tracker import RegionTracker
from tracking3d.trackers.vot_regions import Rectangle, Region


def open_results(path: Path) -> MaskTracker:
    """The results at ``path`` as a mask tracker.

    Args:
        path: A folder of masks, as D3S saves them (``00000002.png`` is the second frame); or a text file: boxes or
            polygons of ``pytracking/tracking_results``, or what the VOT toolkit has stored.

    Raises:
        InputError: If there is nothing there, or it cannot be read.
    """
    if path.is_dir():
        return MaskFolder(path)
    if not path.is_file():
        raise InputError(
            f"There are no results of D3S at {path}; give a folder of masks or a text file of regions."
        )
    regions = read_regions(path)
    return RegionTracker({n: _from_zero(region) for n, region in regions.items()}, "D3S")


def _from_zero(region: Region) -> Region:
    """D3S counts pixels of boxes from 1, those of polygons and masks from 0."""
    if isinstance(region, Rectangle):
        return Rectangle(region.x - 1, region.y - 1, region.width, region.height)
    return region


class MaskFolder:
    """Masks that D3S has saved, numbered from 1 by the frames' order.

    Args:
        folder: Of one sequence.
    """

    def __init__(self, folder: Path) -> None:
        self._masks = open_masks(folder)
        self._position: dict[int, int] = {}
        for position, name in enumerate(self._masks.names):
            digits = re.findall(r"\d+", name)
            if not digits or int(digits[-1]) == 0:
                raise InputError(
                    f"{self._masks.label(position)} has no number from 1 in its name, as D3S writes it; use --masks "
                    "for other folders of masks."
                )
            self._position[int(digits[-1]) - 1] = position

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """The first frame's mask; the prompt's, or its box, where there is none."""
        answer = self.step(frame)
        if answer.mask is not None:
            return answer
        if prompt.mask is not None:
            return MaskEstimate(prompt.mask.astype(np.float32), reason="the mask given with the first frame")
        return RegionTracker({}, "D3S").init(frame, prompt)

    def step(self, frame: Frame) -> MaskEstimate:
        """The frame's mask, or none and the reason."""
        position = self._position.get(frame.index)
        if position is None:
            return MaskEstimate(None, 0.0, "D3S saved no mask for this frame")
        try:
            mask = self._masks.read(position)
        except UnreadableMaskError as error:
            return MaskEstimate(None, 0.0, str(error))
        assert mask is not None  # there is a file
        if mask.shape != frame.size:
            raise InputError(
                f"The mask {self._masks.label(position)} is {mask.shape[1]}x{mask.shape[0]} pixels but "
                f"{frame.name or f'frame {frame.index}'} is {frame.size[1]}x{frame.size[0]}; give the frames that D3S "
                "was run on."
            )
        if not mask.any():
            return MaskEstimate(None, 0.0, "D3S saved an empty mask")
        return MaskEstimate(mask.astype(np.float32))
