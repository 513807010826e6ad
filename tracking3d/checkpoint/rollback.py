"""A run rolled back to before a frame, as a run folder of its own that continues from there."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from tracking3d.checkpoint.integrity import RunIntegrity
from tracking3d.checkpoint.milestones import Milestone, milestones_in
from tracking3d.checkpoint.progress import RunProgress, read_journal
from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d.results.files import link_or_copy, write_atomic, writing
from tracking3d.results.records import jsonable, latest
from tracking3d.results.run_reader import RunReader, read_records


def roll_back(folder: Path, stage: Path, changed: Collection[int]) -> int | None:
    """Copy a run, rolled back to before the first of some frames, into an empty folder, as a stopped run.

    What is copied is whole: if frames before then are damaged, the run is rolled back to before those.

    Args:
        folder: The run; nothing of it is changed.
        stage: Gets the earlier run: its last rollback point before then, and its estimates.
        changed: Indices of those frames; none for the last rollback point.

    Returns:
        Number of frames estimated in it; None if no earlier state was saved, and nothing was copied.

    Raises:
        OutputError: If it cannot be written.
        InputError: If the run is damaged.
    """
    inner = folder / layout.STATE
    milestones, integrity = milestones_in(inner), RunIntegrity(folder)
    while milestones:
        try:
            state = json.loads(milestones[-1].path.read_bytes())
            journal = (inner / layout.JOURNAL).read_bytes()[: state["journal"]]
            taken, _ = read_journal(journal)
            progress = RunProgress(**state["progress"])
            whole = not integrity.of_state(progress, taken)
        except (OSError, ValueError, KeyError, TypeError):  # damaged: try an earlier one
            whole = False
        if whole and not taken.keys() & set(changed):
            _copy_run(folder, stage, milestones, journal, progress.lines)
            return len(taken)
        milestones.pop()
    return None


def _copy_run(folder: Path, stage: Path, milestones: list[Milestone], journal: bytes, lines: int) -> None:
    run = RunReader(folder)
    records = latest(read_records(folder / layout.FRAMES, lines), refined=False)
    causal = folder / layout.CAUSAL
    with writing(stage):
        for inner in (layout.MASKS, layout.INITIAL_MASKS, layout.STATE):
            (stage / inner).mkdir(parents=True, exist_ok=True)
        (stage / layout.STATE / layout.MASKS).mkdir(exist_ok=True)
        if (folder / layout.PROBABILITIES).is_dir():
            (stage / layout.PROBABILITIES).mkdir(exist_ok=True)
        (stage / layout.FRAMES).write_bytes((folder / layout.FRAMES).read_bytes()[:lines])
        for record in records:
            estimates = [layout.mask_path(causal, record.index), layout.mask_path(folder, record.index)]
            initial = layout.initial_mask_path(folder, record.index)
            corrected = layout.mask_path(folder / layout.STATE, record.index)
            likely = layout.probability_path(folder, record.index)
            for file in ([one for one in estimates if one.is_file()][:1], [initial], [corrected], [likely]):
                if file and file[0].is_file():
                    place = file[0].relative_to(causal if file[0].is_relative_to(causal) else folder)
                    link_or_copy(file[0], stage / place)
        for name in sorted({name for one in milestones for name in one.arrays}):
            link_or_copy(folder / layout.STATE / name, stage / layout.STATE / name)
        for one in milestones:
            link_or_copy(one.path, stage / layout.STATE / one.path.name)
        (stage / layout.STATE / layout.JOURNAL).write_bytes(journal)
        link_or_copy(milestones[-1].path, stage / layout.STATE / layout.STATE_FILE)
    description = {**run.description, "state": "interrupted", "refinement": None}
    corrections = (run.description.get("prompt") or {}).get("corrections") or []
    estimated = {record.index for record in records}
    description["prompt"] = {
        **(run.description.get("prompt") or {}),
        "corrections": [one for one in corrections if one["frame"] in estimated],
    }
    write_atomic(stage / layout.RUN, json.dumps(jsonable(description)).encode() + b"\n")


def remove_run(folder: Path) -> None:
    """Remove the files of a run, and its folders if they are empty then; others stay.

    Raises:
        OutputError: If one cannot be removed.
    """
    with writing(folder):
        for path in layout.run_files(folder):
            path.unlink(missing_ok=True)
    remove_empty(folder)


def remove_empty(folder: Path) -> None:
    """Remove the folders within a folder that are empty, and itself."""
    inner = (
        sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True) if folder.is_dir() else []
    )
    for path in (*inner, folder):
        try:
            path.rmdir()
        except OSError:
            continue


def prompt_record_in(run: RunReader) -> dict[str, Any]:
    """The prompt in ``run.json``, see `tracking3d.checkpoint.resuming.prompt_record`.

    Raises:
        InputError: If it has none.
    """
    prompt = run.description.get("prompt")
    if not isinstance(prompt, dict):
        raise InputError(f"The run {run.folder} names no prompt; run the video again, with the correction.")
    return prompt
