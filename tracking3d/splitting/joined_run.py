"""The run folder of the whole video, made of those of its parts: that of a run which was stopped before its end.

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

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.checkpoint.progress import Kept, RunProgress
from tracking3d.frames import SkippedFrame
from tracking3d.geometry.similarity import Similarity
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.frame_lines import FrameLines
from tracking3d.results.mesh_export import export_mesh
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_writer import RunWriter
from tracking3d.session import Session
from tracking3d.splitting.cutting import Part


@dataclass(frozen=True, eq=False)
class PartRun:
    """A part that is tracked.

    Attributes:
        part: Which frames it has.
        folder: Its run folder.
        kept: Its state.
        records: Its causal answers, by the first part's lens.
        similarity: From its object to that of the joined run.
    """

    part: Part
    folder: Path
    kept: Kept
    records: Sequence[FrameRecord]
    similarity: Similarity


def write_joined(
    writer: RunWriter, session: Session, parts: Sequence[PartRun], owned: Sequence[range], seconds: float
) -> None:
    """Write the answers of all parts and the state after them.

    Args:
        writer: Of the folder, just begun; it is ended.
        session: That has the joined object, refined; see `write_causal_mesh` for the object before that.
        parts: All of them.
        owned: Indices of the frames that each part answers for.
        seconds: Wall time so far.

    Raises:
        OutputError: If something cannot be written.
    """
    folder = writer.folder
    writer.finish(None, "interrupted")
    records, taken, skipped = [], [], list[SkippedFrame]()
    for run, mine in zip(parts, owned, strict=True):
        own = [record for record in run.records if record.index in mine]
        records += _moved(own, run.similarity)
        taken += [frame for index, frame in run.kept.taken.items() if index in mine]
        skipped += [frame for frame in run.kept.skipped if frame.index in mine]
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
    checkpoint.save(RunProgress(last, size, refining=True, seconds=seconds), session.kept())


def write_causal_mesh(folder: Path, session: Session) -> None:
    """Write the object as the session has it now.

    Raises:
        OutputError: If it cannot be written.
    """
    export_mesh(folder, session.result())


def take_second_answers(folder: Path, session: Session, made: Sequence[Path], seconds: float) -> None:
    """Put the second answers of all parts where the run looks for what it has looked at again.

    Args:
        folder: The joined run's.
        session: With the joined object.
        made: Folders of the parts' second answers, in order of time; they are emptied.
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
    checkpoint.clear_strangers()


def _moved(records: Sequence[FrameRecord], similarity: Similarity) -> list[FrameRecord]:
    if not records:
        return []
    poses = similarity.poses(np.stack([record.T_cam_obj for record in records]))
    return [
        replace(record, T_cam_obj=pose, revision=False) for record, pose in zip(records, poses, strict=True)
    ]


def _copy_masks(source: Path, target: Path, indices: Sequence[int]) -> None:
    with writing(target):
        if (source / layout.PROBABILITIES).is_dir():
            (target / layout.PROBABILITIES).mkdir(exist_ok=True)
        for path_of in (layout.mask_path, layout.initial_mask_path, layout.probability_path):
            for index in indices:
                with suppress(
                    FileNotFoundError
                ):  # where the mask tracker gave none, or no probabilities are kept
                    shutil.copyfile(path_of(source, index), path_of(target, index))
