"""The landmarks of a run, read from the checkpoint that it keeps until it is finished."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.results import layout
from tracking3d.runtime.array_files import ArrayFile

_LARGEST_STATE = 2**26  # bytes of the state's text
_LARGEST_ARRAY = 2**28
_MOST = 200_000
_ARRAY = re.compile(r"\d{8,}\.npz")


def landmarks_of_checkpoint(folder: Path) -> NDArray[np.float32] | None:
    """The landmarks ``(N, 3)`` of a run that goes on or was stopped, in object coordinates; None if none are kept.

    Args:
        folder: The run folder.
    """
    state = folder / layout.STATE
    try:
        path = state / layout.STATE_FILE
        if path.stat().st_size > _LARGEST_STATE:
            return None
        session = dict(json.loads(path.read_bytes())["session"]["dict"])
        name = session["solver"]["fields"]["known"]["fields"]["landmarks"]["file"]
        if not _ARRAY.fullmatch(name):
            return None
        with ArrayFile(state / name) as arrays:
            points = np.asarray(arrays.read("array", _LARGEST_ARRAY), np.float32)
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        RecursionError,
    ):  # of another solver, none yet, or just being replaced
        return None
    if points.ndim != 2 or points.shape[1] != 3:
        return None
    points = points[np.isfinite(points).all(axis=1)][:_MOST]
    return points if len(points) else None
