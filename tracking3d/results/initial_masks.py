"""The mask tracker's masks in a run folder, ``initial_masks/``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tracking3d.frames import Frame, MaskEstimate
from tracking3d.results import layout
from tracking3d.results.files import read_mask


def is_initial_mask(folder: Path, frame: Frame, estimate: MaskEstimate) -> bool:
    """Whether a mask tracker's estimate for a frame is the one that the run folder holds."""
    kept, given = read_mask(layout.initial_mask_path(folder, frame.index)), estimate.binary
    if kept is None or given is None:
        return all(mask is None or not mask.any() for mask in (kept, given))
    return np.array_equal(kept, given)
