"""The mask tracker's masks in a run folder, ``initial_masks/``, and what it says is in front of the object.

One PNG a frame: 255 the object, 64 an occluder, 0 the rest.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Frame, MaskEstimate
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_mask
from tracking3d.results.visible_masks import expect_visible_masks


def write_initial_mask(
    folder: Path, index: int, mask: NDArray[np.bool_], occluder: NDArray[np.bool_] | None
) -> None:
    """Write what a mask tracker gave for frame ``index``.

    Args:
        folder: The run folder.
        index: Index of the frame.
        mask: ``(H, W)``.
        occluder: ``(H, W)`` what is in front of the object; None if nothing is known.

    Raises:
        OutputError: If it cannot be written.
    """
    if occluder is not None and occluder.any():
        expect_visible_masks(folder)
    write_mask(layout.initial_mask_path(folder, index), mask, occluder)


def is_initial_mask(folder: Path, frame: Frame, estimate: MaskEstimate) -> bool:
    """Whether a mask tracker's estimate for a frame is the one that the run folder holds."""
    kept, given = read_mask(layout.initial_mask_path(folder, frame.index)), estimate.binary
    if kept is None or given is None:
        return all(mask is None or not mask.any() for mask in (kept, given))
    return np.array_equal(kept, given)
