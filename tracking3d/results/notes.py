"""What somebody who looks at a run should know, in sentences: what was assumed, and what was never seen."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.results.records import FrameRecord

MOSTLY = 0.5
"""Share of the surface never seen from which a note says so."""
UNEVEN = 1.5
"""How much longer than the shortest the longest time between two frames is, for a note to say so."""

_CORNERS = 6  # points a side of a face at which the texture is asked


def notes_of_run(run: dict[str, Any], model: ObjectModel | None, records: Sequence[FrameRecord]) -> list[str]:
    """All notes of a run.

    Args:
        run: Its ``run.json``, before the notes are in it.
        model: The object; None if there is none.
        records: The answer for every frame, in order.
    """
    # Nobody expects frames to come evenly from a camera, which has no number of frames either.
    counted = (run.get("given") or {}).get("frames") is not None
    return [
        *run["source_notes"],
        *(notes_of_times(records) if counted else ()),
        *describe_camera_and_model(run["camera"], model),
    ]


def describe_camera_and_model(camera: dict[str, Any], model: ObjectModel | None) -> list[str]:
    """What is known of lens and model.

    Args:
        camera: As ``run.json`` has it.
        model: The object; None if there is none.
    """
    notes = []
    if camera["assumed"]:
        solved = camera["origin"].startswith("solved")
        told = (
            "the final refinement solved it" if solved else "give --fov or --intrinsics where depth matters"
        )
        notes.append(f"nobody gave the lens: {camera['origin']}; {told}")
    unseen = unseen_share(model) if model is not None else 0.0
    if unseen > MOSTLY:
        notes.append(f"{100 * unseen:.0f} % of the mesh's surface was never seen; what is there is a guess")
    return notes


def notes_of_times(records: Sequence[FrameRecord]) -> list[str]:
    """What one should know of the times of a run's frames: that they do not come evenly.

    Args:
        records: The answer for every frame, in order.
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
        f"frames come {shortest:.0f} to {longest:.0f} ms apart (variable frame rate); time stamps are the video's, and "
        "overlay.mp4 shows them evenly"
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
