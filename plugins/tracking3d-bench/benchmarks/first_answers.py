"""What a run said of each frame when it came, what it said of it later, and at what cost.

python benchmarks/first_answers.py RUN --truth CLIP

``frames.jsonl`` has a line for each answer. From the first frame with a map on, the first line of each frame is what a
live user sees; a later one that is not refined revises it. Printed are the errors of both, those of the steps from one
frame to the next into a keyframe, out of one and elsewhere, frames that were called ``tracked`` more than 10 degrees
off, and frames a second and the peak of memory. The clip's poses are the truth; frames without one do not count.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from script import run
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.geometry.alignment import Rotations
from tracking3d.results import layout
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors, consecutive_rotation_errors

WRONG = 10.0
"""Degrees from which on a pose is wrong."""


def first_and_last(records: Iterable[FrameRecord]) -> tuple[dict[int, FrameRecord], dict[int, FrameRecord]]:
    """The first causal answer of each frame from the first map on, and the last causal one, by frame."""
    first, last = dict[int, FrameRecord](), dict[int, FrameRecord]()
    begun = False
    for record in records:
        if record.refined or not record.has_pose:
            continue
        begun |= record.keyframe or record.revision
        if begun and not record.revision:
            first.setdefault(record.index, record)
        last[record.index] = record
    return first, {index: last[index] for index in first}


def measure(folder: Path, clip: Path) -> dict[str, Any]:
    """The figures of one run, see the module; angles are means in degrees.

    Args:
        folder: A run folder.
        clip: The clip with true poses whose frames the run has.

    Raises:
        InputError: If no frame has both a true pose and an answer from a map.
    """
    truth = read_truth(clip).T_cam_obj
    first, last = first_and_last(read_records(folder / layout.FRAMES))
    known = sorted(first.keys() & truth.keys())
    if len(known) < 2:
        raise InputError(f"{folder} has no two frames with a map whose pose {clip} knows.")
    R_true = np.stack([truth[index][:3, :3] for index in known])

    def rotations(answers: dict[int, FrameRecord]) -> Rotations:
        return np.stack([np.asarray(answers[index].T_cam_obj)[:3, :3] for index in known])

    errors = aligned_rotation_errors(rotations(first), R_true)
    steps = consecutive_rotation_errors(rotations(first), R_true)
    keyframe = np.array([first[index].keyframe for index in known])
    following = np.diff(known) == 1
    kinds = {
        "step_into_keyframe_deg": following & keyframe[1:],
        "step_out_of_keyframe_deg": following & keyframe[:-1] & ~keyframe[1:],
        "other_step_deg": following & ~keyframe[:-1] & ~keyframe[1:],
    }
    tracked = np.array([first[index].status is Status.TRACKED for index in known])
    seconds = sum(record.seconds for record in first.values())
    return {
        "run": str(folder),
        "from_frame": known[0],
        "frames": len(known),
        "first_deg": float(errors.mean()),
        "first_median_deg": float(np.median(errors)),
        "first_max_deg": float(errors.max()),
        "revised_deg": float(aligned_rotation_errors(rotations(last), R_true).mean()),
        **{name: float(steps[chosen].mean()) if chosen.any() else None for name, chosen in kinds.items()},
        "tracked": int(tracked.sum()),
        "tracked_and_wrong": int((tracked & (errors > WRONG)).sum()),
        "frames_a_second": len(first) / seconds if seconds else None,
        "peak_memory_mb": RunReader(folder).description.get("peak_memory_mb"),
    }


def first_answers(
    folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    truth: Annotated[Path, typer.Option(metavar="CLIP", help="The clip with its poses.")],
) -> None:
    """Print the figures of RUN's first answers as JSON."""
    typer.echo(json.dumps(measure(folder, truth), indent=2))


if __name__ == "__main__":
    run(first_answers)
