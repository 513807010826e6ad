"""Object probabilities per pixel as files: 0 for 0, 255 for 1."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.results import layout
from tracking3d.results.files import write_image, writing


def write_probability(folder: Path, index: int, probability: NDArray[np.float32] | None) -> None:
    """Write it ``(H, W)`` beside the masks of a folder; None removes that of an earlier estimate.

    Raises:
        OutputError: If it cannot be written.
    """
    path = layout.probability_path(folder, index)
    with writing(path):
        path.parent.mkdir(exist_ok=True)
        if probability is None:
            path.unlink(missing_ok=True)
    if probability is not None:
        write_image(path, np.rint(255 * probability).clip(0, 255).astype(np.uint8))


def read_probability(folder: Path, index: int) -> NDArray[np.float32] | None:
    """It again ``(H, W)``, in steps of 1/255; None if there is none."""
    path = layout.probability_path(folder, index)
    if not path.is_file() or not path.stat().st_size:
        return None
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if image is None else image.astype(np.float32) / 255


def take_over_probability(aside: Path, folder: Path, index: int) -> None:
    """Replace the causal estimate's probability by the refined one's, in a run that has them.

    Raises:
        OSError: If it cannot be moved.
    """
    if not (folder / layout.PROBABILITIES).is_dir():
        return
    refined, place = layout.probability_path(aside, index), layout.probability_path(folder, index)
    if refined.is_file():
        refined.replace(place)
    else:
        place.unlink(missing_ok=True)
