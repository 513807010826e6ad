"""Notes of ``run.json`` for readers of a run, in sentences: assumptions, and surface that was never seen."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from tracking3d.estimation.estimate import FREE_ROTATION, ObjectModel
from tracking3d.geometry.camera import LENS_KNOWN
from tracking3d.results.records import FrameRecord

MOSTLY = 0.5
"""Share of unseen surface above which a note is written."""
CERTAIN = 0.02
"""Relative standard deviation of an estimated focal length up to which no note is written: depth is off by as much.
It was .012 on temple_ring and .011 on fox_walk, where the estimate is off by .003 and .021, and .026 in the first 46
frames of box_in_hand, where it is off by .1."""
UNEVEN = 1.5
"""Ratio of the longest to the shortest frame interval above which a note is written."""

_CORNERS = 6  # points a side of a face at which the texture is asked


def notes_of_run(run: dict[str, Any], model: ObjectModel | None, records: Sequence[FrameRecord]) -> list[str]:
    """All notes of a run.

    Args:
        run: Its ``run.json``, before the notes are in it.
        model: The object; None if there is none.
        records: The estimate for every frame, in order.
    """
    # A camera is not expected to deliver frames evenly; it has no number of frames either.
    counted = (run.get("prompt") or {}).get("frames") is not None
    revolved = any(one.free_axis for one in records)
    advice = "" if revolved else advice_on_photos(run)  # it is tracked without points that could join photos
    return [
        *run["source_notes"],
        *(notes_of_times(records) if counted else ()),
        *([advice] if advice else ()),
        *([FREE_ROTATION] if revolved else ()),
        *describe_camera_and_model(run["camera"], None if advice else model),
    ]


def advice_on_photos(run: dict[str, Any]) -> str:
    """Which photos of a set could not be joined, and what to do, as ``run.json`` has it; empty if all were."""
    return ((run.get("refinement") or {}).get("start") or {}).get("advice", "")


def describe_camera_and_model(camera: dict[str, Any], model: ObjectModel | None) -> list[str]:
    """Notes on lens and model.

    Args:
        camera: As ``run.json`` has it.
        model: The object; None if there is none.
    """
    notes = []
    deviation = camera.get("focal_deviation")
    if is_lens_uncertain(camera):
        uncertain = "" if deviation is None else f", uncertain by {100 * deviation:.0f} % of the focal length"
        if deviation is not None and deviation > LENS_KNOWN and "solved" not in camera["origin"]:
            uncertain = ", and the video does not tell it"
        notes.append(
            f"no focal length was given: {camera['origin']}{uncertain}; give --fov or --intrinsics if depth matters"
        )
    unseen = unseen_share(model) if model is not None else 0.0
    if unseen > MOSTLY:
        notes.append(
            f"{100 * unseen:.0f} % of the mesh's surface was never seen and is a guess; film its other sides in a "
            "second video, and add them by --object RUN --extend"
        )
    return notes


def is_lens_uncertain(camera: dict[str, Any]) -> bool:
    """Whether the focal length was not given, and could not be estimated well.

    Args:
        camera: As ``run.json`` has it.
    """
    deviation = camera.get("focal_deviation")
    return camera["assumed"] and (deviation is None or deviation > CERTAIN)


def notes_of_times(records: Sequence[FrameRecord]) -> list[str]:
    """A note if the frames of a run are not evenly spaced in time.

    Args:
        records: The estimate for every frame, in order.
    """
    timed = [(one.index, one.time) for one in records if one.time is not None]
    steps = np.array(
        [
            (later - time) / (after - index)
            for (index, time), (after, later) in pairwise(timed)
            if after > index
        ]
    )
    if len(steps) < 2 or not 0 < steps.min() * UNEVEN < steps.max():
        return []
    shortest, longest = 1000 * steps.min(), 1000 * steps.max()
    return [
        f"frame intervals vary from {shortest:.0f} to {longest:.0f} ms (variable frame rate); time stamps "
        "are those of the video, but overlay.mp4 plays at a constant rate"
    ]


def unseen_share(model: ObjectModel) -> float:
    """Share of the mesh's surface whose texture has the weight 0."""
    steps = (np.arange(_CORNERS) + 1 / 3) / _CORNERS
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    weights = np.stack([1 - a - b, a, b], axis=1)[a + b < 1]
    u, v = np.einsum("kc,fcd->dfk", weights, model.face_uvs)
    height, width = model.texture_weight.shape
    column = np.floor(u * width).astype(np.int64) % width  # the atlas wraps in u and is clamped in v
    row = np.clip(np.floor(v * height).astype(np.int64), 0, height - 1)
    unseen = (model.texture_weight[row, column] <= 0).mean(1)
    corners = model.vertices[model.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return float(unseen @ area / area.sum()) if area.sum() > 0 else 0.0
