"""What a solver sees of a video that a distorting lens took, and its estimates for the pictures as they were taken.

Everything around the solver, the mask tracker, prompts and estimates, is in pixels of the pictures. Poses and the
solver's own state are of the pinhole camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.lens import Lens


@dataclass(frozen=True)
class Undistortion:
    """Between the pictures and the solver's pinhole camera; without distortion everything stays as it is."""

    lens: Lens | None  # None if there is no distortion

    def frame(self, frame: Frame) -> Frame:
        """A frame as the solver sees it."""
        return frame if self.lens is None else replace(frame, image=self.lens.undistort(frame.image))

    def mask(self, mask: MaskEstimate) -> MaskEstimate:
        """A frame's initial mask as the solver sees it."""
        if self.lens is None:
            return mask
        seen, occluder = mask.mask, mask.occluder
        return replace(
            mask,
            mask=None if seen is None else self.lens.mask_to_pinhole(seen.astype(np.float32)),
            occluder=None if occluder is None else self.lens.mask_to_pinhole(occluder),
        )

    def binary(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """A mask ``(H, W)`` that is right as the solver sees it."""
        return mask if self.lens is None else self.lens.mask_to_pinhole(mask)

    def each(self, frames: Iterable[tuple[Frame, MaskEstimate]]) -> Iterator[tuple[Frame, MaskEstimate]]:
        """Frames with their initial masks as the solver sees them."""
        return ((self.frame(frame), self.mask(mask)) for frame, mask in frames)

    def estimate(self, estimate: FrameEstimate, mask: MaskEstimate | None = None) -> FrameEstimate:
        """The solver's estimate for the picture; ``mask`` is the initial mask that it was given, if it is known."""
        if self.lens is None:
            return estimate
        initial = mask.found if mask is not None else self._distorted(estimate.initial_mask)
        handed_back = estimate.mask_source is MaskSource.INITIAL and initial is not None
        own = initial if handed_back else self._distorted(estimate.mask)
        assert own is not None
        return replace(
            estimate,
            mask=own,
            initial_mask=initial,
            probability=self._distorted(estimate.probability),
            revised=tuple(self.estimate(earlier) for earlier in estimate.revised),
        )

    def _distorted(self, mask: NDArray | None) -> NDArray | None:
        return None if mask is None or self.lens is None else self.lens.mask_to_picture(mask)
