"""A run is corrected in a copy within its folder, which takes its place when it is finished, and not before.

Until then the run is as it was, whatever ends the correction. A kill while the copy takes its place leaves the rest
of that to the next call.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Mapping
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

from tracking3d.errors import InputError, OutputError
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint, RollbackPoint, rollback_points_in
from tracking3d.results.checkpoint.integrity import RunIntegrity
from tracking3d.results.checkpoint.progress import RunProgress, SavedState, read_journal
from tracking3d.results.checkpoint.resuming import Earlier, changed_frames, earlier_run
from tracking3d.results.files import is_locked, link_or_copy, try_lock, write_atomic, writing
from tracking3d.results.records import jsonable, latest
from tracking3d.results.refinement_writer import clear_refinement, undo_taking_over
from tracking3d.results.run_reader import (
    FormatError,
    RunReader,
    is_finished,
    read_records,
    replacement_has_begun,
)
from tracking3d.results.run_unit import complete_scaling

_log = logging.getLogger(__name__)


def stage_correction(
    folder: Path,
    config: Mapping[str, Any],
    selection: str | None,
    given: Mapping[str, Any],
    ends: ExitStack,
) -> tuple[Path, Earlier]:
    """The folder in which a corrected run is computed: from the last state before the correction, if one was saved.

    A finished run that is damaged is computed again in the same way, from the last state of which all is whole.

    Args:
        folder: The run folder.
        config: See `tracking3d.results.checkpoint.resuming.earlier_run`.
        selection: See there.
        given: See there.
        ends: When it is left, the corrected run, if it is finished, takes the place of the other one.

    Returns:
        A folder within, and what is in it: ``none``, ``stopped``, or ``finished`` if only the shape of its model is
        to be reconstructed, see `keeps_shape`.

    Raises:
        OutputError: If the run is being corrected at this moment, or something cannot be written.
        InputError: If it is damaged.
    """
    stage = folder / layout.CORRECTING
    if is_locked(stage / layout.FRAMES):
        raise OutputError(f"{folder} is being corrected at this moment; wait for that.")
    ends.callback(take_over, folder)
    lock = ends.enter_context((folder / layout.FRAMES).open("rb"))
    if not try_lock(lock.fileno()):
        raise OutputError(f"{folder} is in use by another run; wait for it.")
    there = _earlier_correction(stage, config, selection, given)
    if there in ("stopped", "finished"):
        _log.info("Continuing what was begun in %s.", stage)
        return stage, there
    remove_run(stage)
    changed = changed_frames(folder, given)
    estimated = roll_back(folder, stage, changed)
    if estimated is None:
        _log.warning(
            "No checkpoint%s is saved in %s, so that all frames are computed again%s.",
            f" before frame {min(changed)}" if changed else "",
            folder,
            "; frames before the correction get the estimates that they had" if changed else "",
        )
        return stage, "none"
    return stage, "stopped"


def keeps_shape(folder: Path) -> bool:
    """Whether the shape of a run's model was reconstructed after tracking, and is to be when the run is corrected.

    Raises:
        InputError: If it is no run.
    """
    wanted = RunReader(folder).config.get("object", {}).get("shape") == "fine"
    return wanted or (folder / layout.ONLINE / layout.FEATURES).is_file()


def take_over(folder: Path) -> None:
    """Replace a run by its corrected run, if that is finished, its model included.

    What was exported of the run as it was is kept in `layout.EXPORT_BEFORE`. A scaling that was interrupted is
    completed, too.

    Raises:
        OutputError: If a file cannot be moved.
    """
    stage = folder / layout.CORRECTING
    try:
        complete_scaling(folder)
        begun = replacement_has_begun(folder)
        if not is_finished(stage) or is_locked(stage / layout.FRAMES):
            return
        if not begun and keeps_shape(folder) and "shape" not in RunReader(stage).description:
            return
    except InputError:  # damaged: the next correction makes it again
        return
    with writing(folder):
        new = [path.relative_to(stage) for path in layout.run_files(stage)]
        if not begun:
            old = {path.relative_to(folder) for path in layout.run_files(folder)}
            gone = {path for path in old if path.parts[0] != layout.CORRECTING} - set(new)
            for path in gone:
                (folder / path).unlink(missing_ok=True)
            for inner in {path.parent for path in gone} - {Path()}:
                remove_empty(folder / inner)
            _set_export_aside(folder)
        # The lines first, which say that it was begun; the description last, which says that it is not done.
        order = {Path(layout.FRAMES): 0, Path(layout.RUN): 2}
        for path in sorted(new, key=lambda one: order.get(one, 1)):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (stage / path).replace(folder / path)
            (stage / path).unlink(missing_ok=True)  # of two names of one file nothing is renamed
    remove_empty(stage)


def _set_export_aside(folder: Path) -> None:
    """Give what was exported another name, since it shows the run as it was."""
    if not (folder / layout.EXPORT).is_dir():
        return
    names = (layout.EXPORT_BEFORE + (f"_{number}" if number > 1 else "") for number in count(1))
    (folder / layout.EXPORT).rename(next(folder / name for name in names if not (folder / name).exists()))


def _earlier_correction(
    stage: Path, config: Mapping[str, Any], selection: str | None, given: Mapping[str, Any]
) -> Earlier:
    """How far the same correction came before it was stopped: ``stopped`` or ``finished``; ``none`` for another one."""
    try:
        earlier = earlier_run(stage, config, selection, given)
    except (InputError, OutputError):
        return "none"
    return "none" if earlier == "stopped" and not layout.has_state(stage) else earlier


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
    rollback_points, integrity = rollback_points_in(inner), RunIntegrity(folder)
    while rollback_points:
        try:
            state = json.loads(rollback_points[-1].path.read_bytes())
            journal = (inner / layout.JOURNAL).read_bytes()[: state["journal"]]
            taken, skipped = read_journal(journal)
            progress = RunProgress(**state["progress"])
            whole = not integrity.of_state(progress, taken)
        except (OSError, ValueError, KeyError, TypeError):  # damaged: try an earlier one
            whole = False
        if whole and not {*taken, *(one.index for one in skipped)} & set(changed):
            _copy_run(folder, stage, rollback_points, journal, progress.lines)
            return len(taken)
        rollback_points.pop()
    return None


def _copy_run(
    folder: Path, stage: Path, rollback_points: list[RollbackPoint], journal: bytes, lines: int
) -> None:
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
        for name in sorted({name for one in rollback_points for name in one.arrays}):
            link_or_copy(folder / layout.STATE / name, stage / layout.STATE / name)
        for one in rollback_points:
            link_or_copy(one.path, stage / layout.STATE / one.path.name)
        (stage / layout.STATE / layout.JOURNAL).write_bytes(journal)
        link_or_copy(rollback_points[-1].path, stage / layout.STATE / layout.STATE_FILE)
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
    """The prompt in ``run.json``, see `tracking3d.results.checkpoint.resuming.prompt_record`.

    Raises:
        InputError: If it has none.
    """
    prompt = run.description.get("prompt")
    if not isinstance(prompt, dict):
        raise InputError(f"The run {run.folder} names no prompt; run the video again, with the correction.")
    return prompt


def read_intact_state(folder: Path, checkpoint: Checkpoint) -> SavedState | None:
    """Read the last saved state of a stopped run whose frames are all whole; an earlier one takes its place.

    If it is not the very last state, one sentence says what is damaged, and where the run goes on.

    Args:
        folder: The run folder.
        checkpoint: Its checkpoint.

    Returns:
        The state; None if frames are damaged and no state from before them was saved: the run begins again.

    Raises:
        InputError: If the last state itself is damaged and there is no other.
        FormatError: If it was written by another version.
        OutputError: If an earlier state cannot take its place.
    """
    integrity, why, unreadable = RunIntegrity(folder), "", None
    for name in (layout.STATE_FILE, *checkpoint.earlier_states()):
        try:
            kept = checkpoint.read(name)
        except FormatError:
            raise
        except InputError as error:
            unreadable, why = unreadable or error, why or f"{layout.STATE}/{name} is damaged"
            continue
        damage = integrity.of_state(kept.progress, kept.taken)
        if not damage:
            if why:
                _return_to(folder, checkpoint, name, kept, why)
            return kept
        why = why or damage
    if unreadable is not None:
        raise unreadable
    _log.warning("%s: %s, and no state from before that is saved; the run begins again.", folder, why)
    return None


def _return_to(folder: Path, checkpoint: Checkpoint, name: str, kept: SavedState, why: str) -> None:
    if kept.progress.refining:
        _log.warning("%s: %s; the final refinement begins again.", folder, why)
    else:
        with writing(folder):
            undo_taking_over(folder)
        clear_refinement(folder)
        last = kept.progress.last
        _log.warning(
            "%s: %s; the run goes on after frame %d, the last one whose state is saved.", folder, why, last
        )
    checkpoint.return_to(name)
