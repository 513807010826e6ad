"""The masks given by the user, stored so that a correction can restart from the same prompts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Prompt
from tracking3d.prompts.corrections import Correction
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_mask, writing


def keep_given_masks(
    folder: Path, first: int, prompt: Prompt | None, corrections: Iterable[Correction] = ()
) -> None:
    """Write the masks of the first frame and of corrections, if they were given as masks.

    Args:
        folder: The run folder.
        first: Index of the frame that the prompt is of.
        prompt: The object in it.
        corrections: What it is in later frames.

    Raises:
        OutputError: If one cannot be written.
    """
    given = {one.frame: one.mask for one in corrections if isinstance(one.mask, np.ndarray)}
    if prompt is not None and prompt.mask is not None and prompt.points is None:
        given[first] = prompt.mask
    if given:
        with writing(folder):
            (folder / layout.PROMPTS).mkdir(exist_ok=True)
    for index, mask in given.items():
        write_mask(layout.prompt_path(folder, index), mask)


def read_given_mask(folder: Path, index: int) -> NDArray[np.bool_]:
    """The mask ``(H, W)`` that was given for a frame.

    Raises:
        InputError: If it is missing or damaged.
    """
    mask = read_mask(path := layout.prompt_path(folder, index))
    if mask is None:
        raise InputError(
            f"The mask {path} that was given to the run is missing or damaged; give it again with "
            "`tracking3d run` --resume, --mask and --correct."
        )
    return mask
