"""The initial masks of a video that was tracked, for passes that follow."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Frame, MaskEstimate
from tracking3d.results.refined_estimates import RefinedEstimates


@dataclass(frozen=True, eq=False)
class SavedMasks:
    """What the mask tracker gave for each frame."""

    estimates: RefinedEstimates  # the estimates of the run, in whose folder the masks are
    initial: Mapping[int, tuple[float, str]]  # score and reason of every frame's initial mask, by index

    def has_mask(self, index: int) -> bool:
        """Whether the mask tracker saw the object in a frame."""
        return self.estimates.causal[index].iou_initial is not None

    def of(self, frame: Frame) -> MaskEstimate:
        """The initial mask of a frame."""
        return self.estimate(frame.index, self.estimates.initial_mask(frame.index))

    def estimate(self, index: int, mask: NDArray[np.bool_] | None) -> MaskEstimate:
        """The initial mask ``(H, W)`` of a frame with its score and reason."""
        score, reason = self.initial.get(index, (1.0, ""))
        occluder = None if mask is None else self.estimates.occluder(index)
        return MaskEstimate(None if mask is None else mask.astype(np.float32), score, reason, occluder)

    def with_masks(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, MaskEstimate]]:
        """Frames with their initial masks."""
        return ((frame, self.of(frame)) for frame in frames)
