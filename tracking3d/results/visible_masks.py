"""What is seen of the object, ``visible_masks/``: the estimated masks without what is in front of them.

They are written at the end of a run whose mask tracker says what is in front of the object.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.results import layout
from tracking3d.results.files import read_mask, read_packed_mask, unpack, write_mask, writing


def expect_visible_masks(folder: Path) -> None:
    """Make the folder of the visible masks, so that they are written at the end.

    Args:
        folder: The run folder.

    Raises:
        OutputError: If it cannot be made.
    """
    with writing(folder / layout.VISIBLE_MASKS):
        (folder / layout.VISIBLE_MASKS).mkdir(exist_ok=True)


def write_visible_masks(folder: Path) -> None:
    """Write what is seen of the object in every frame of a run, if it is known.

    Args:
        folder: The run folder, with the final masks.

    Raises:
        OutputError: If something cannot be written.
    """
    if not (folder / layout.VISIBLE_MASKS).is_dir():
        return
    for path in sorted((folder / layout.MASKS).glob("*.png")):
        mask, occluder = read_mask(path), read_occluder(folder, int(path.stem))
        if mask is not None:
            visible = mask if occluder is None else mask & ~occluder
            write_mask(layout.visible_mask_path(folder, int(path.stem)), visible)


def read_occluder(folder: Path, index: int) -> NDArray[np.bool_] | None:
    """What is in front of the object in frame ``index``, ``(H, W)``; None if nothing is known to be."""
    kept = read_packed_mask(layout.initial_mask_path(folder, index))
    return None if kept is None or kept.occluder is None else unpack(kept.occluder, kept.shape)
