"""The run folder of the whole video, merged from those of its parts: a run stopped before its final refinement.

Whatever happens from there on, ``resume`` finishes it as it does any stopped run.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from tracking3d.frames import SkippedFrame
from tracking3d.geometry.similarity import Similarity
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.submaps.cuts import Part
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.progress import RunProgress, SavedState
from tracking3d.results.files import writing
from tracking3d.results.mesh_export import export_mesh
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_writer import FrameLines, RunWriter


@dataclass(frozen=True, eq=False)
class PartRun:
    """A part that is tracked."""

    part: Part  # which frames it has
    folder: Path  # its run folder
    kept: SavedState  # its saved state
    records: Sequence[FrameRecord]  # its causal estimates, by the first part's lens
    similarity: Similarity  # from its object to that of the merged run


def write_merged_run(
    writer: RunWriter, session: Session, parts: Sequence[PartRun], owned: Sequence[range], seconds: float
) -> None:
    """Write the estimates of all parts and the state after them.

    Args:
        writer: The new writer of the folder; it is closed.
        session: The session with the merged, refined object; see `write_causal_mesh` for the object before that.
        parts: All of them.
        owned: Indices of the frames whose estimates are taken from each part.
        seconds: Wall time so far.

    Raises:
        OutputError: If something cannot be written.
    """
    folder = writer.folder
    writer.finish(None, "interrupted")
    records, taken, skipped = [], [], list[SkippedFrame]()
    for run, mine in zip(parts, owned, strict=True):
        own = [record for record in run.records if record.index in mine]
        records += _transform_records(own, run.similarity)
        taken += [frame for index, frame in run.kept.taken.items() if index in mine]
        # A picture that repeats the one before has its line already, and is a frame like any other from here on.
        skipped += [frame for frame in run.kept.skipped if frame.index in mine and frame.repeats is None]
        _copy_masks(run.folder, folder, [record.index for record in own])
    lines = FrameLines(folder)
    try:
        lines.begin()
        lines.append(records)
        size = lines.size
    finally:
        lines.close()
    checkpoint = Checkpoint(folder, session.state_classes, session.config.runtime.device)
    for frame in taken:
        checkpoint.note(frame)
    for one in skipped:
        checkpoint.note(one)
    last = records[-1].index if records else -1
    checkpoint.save(RunProgress(last, size, refining=True, seconds=seconds), session.state_dict())


def write_causal_mesh(folder: Path, session: Session) -> None:
    """Write the object as the session has it now.

    Raises:
        OutputError: If it cannot be written.
    """
    export_mesh(folder, session.result())


def move_refined_estimates(folder: Path, session: Session, made: Sequence[Path], seconds: float) -> None:
    """Move the refined estimates of all parts to the place where the run expects its refined estimates.

    Args:
        folder: The folder of the merged run.
        session: The session with the merged object.
        made: Folders of the parts' refined estimates, in order of time; they are emptied.
        seconds: Wall time of the refinement so far.

    Raises:
        OutputError: If something cannot be written.
    """
    aside = folder / layout.REFINING
    lines = b"".join((one / layout.FRAMES).read_bytes() for one in made)
    with writing(aside):
        for one, kind in product(made, (layout.MASKS, layout.PROBABILITIES)):
            if (one / kind).is_dir():
                (aside / kind).mkdir(parents=True, exist_ok=True)
                for file in sorted((one / kind).iterdir()):
                    file.replace(aside / kind / file.name)
        (aside / layout.FRAMES).write_bytes(lines)
    checkpoint = Checkpoint(folder, session.state_classes, session.config.runtime.device)
    before = checkpoint.read()
    done = replace(
        before.progress,
        last_refined=before.progress.last,
        refined_lines=len(lines),
        refinement_seconds=seconds,
    )
    checkpoint.save(done, before.session)
    checkpoint.remove_orphans()


def _transform_records(records: Sequence[FrameRecord], similarity: Similarity) -> list[FrameRecord]:
    if not records:
        return []
    poses = similarity.poses(np.stack([record.T_cam_obj for record in records]))
    axes = [record.free_axis and tuple((similarity.R @ record.free_axis).tolist()) for record in records]
    return [
        replace(record, T_cam_obj=pose, free_axis=axis, revision=False)
        for record, pose, axis in zip(records, poses, axes, strict=True)
    ]


def _copy_masks(source: Path, target: Path, indices: Sequence[int]) -> None:
    with writing(target):
        for kind in (layout.PROBABILITIES, layout.VISIBLE_MASKS):  # the latter are written at the end
            if (source / kind).is_dir():
                (target / kind).mkdir(exist_ok=True)
        for path_of in (layout.mask_path, layout.initial_mask_path, layout.probability_path):
            for index in indices:
                with suppress(
                    FileNotFoundError
                ):  # if the mask tracker gave none, or no probabilities are saved
                    shutil.copyfile(path_of(source, index), path_of(target, index))
