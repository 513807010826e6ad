"""When a segmentation network is run again, and when flow and colours propagate its last mask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tracking3d.frames import Box, MaskEstimate
from tracking3d.trackers.crops import box_iou, box_of

_LONGEST = 6  # frames without a new mask of the network
_DROPPED = 0.85  # of the score right after the network's mask
_CHANGED = 0.7  # IoU with the box of the network's mask, moved to the same centre
_APART = 0.1  # drop of the IoU of the mask's box and the box tracker's


@dataclass
class NetworkSchedule:
    """Decides in which frames the network is run."""

    # it is run in every k-th frame; auto: if something has changed since its last mask, and in every sixth
    # frame
    every: int | Literal["auto"]
    _frames: int = 0
    _size: Box | None = None
    _score: float | None = None
    _agreement: float | None = None
    _corrected: bool = False

    def is_due(self, carried: MaskEstimate, box: Box | None) -> bool:
        """Whether the network is to be run in the present frame.

        Args:
            carried: The propagated mask.
            box: ``(x, y, w, h)`` of the box tracker; None if it has lost the object.
        """
        self._frames += 1
        if carried.reason or carried.mask is None:
            return True
        if self.every != "auto":
            return self._frames >= self.every
        found = box_of(carried.mask)
        if found is None or box is None or self._corrected or self._frames >= _LONGEST:
            return True
        agreement = box_iou(found, box)
        if self._score is None or self._agreement is None:  # the first mask that was propagated
            self._score, self._agreement = carried.score, agreement
        changed = self._size is None or _same_size(found, self._size) < _CHANGED
        return changed or carried.score < _DROPPED * self._score or agreement < self._agreement - _APART

    def was_run(self, box: Box | None) -> None:
        """Begin again after a mask of the network.

        Args:
            box: ``(x, y, w, h)`` of that mask.
        """
        self._frames, self._corrected = 0, False
        self._size, self._score, self._agreement = box, None, None

    def was_corrected(self) -> None:
        """Take note that the solver has disagreed with the last mask."""
        self._corrected = True


def _same_size(one: Box, other: Box) -> float:
    """IoU of two boxes that are moved to the same centre."""
    return box_iou((-one[2] / 2, -one[3] / 2, *one[2:]), (-other[2] / 2, -other[3] / 2, *other[2:]))
