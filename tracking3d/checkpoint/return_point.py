"""The state from which a stopped run goes on: the last one of which everything is whole."""

from __future__ import annotations

import logging
from pathlib import Path

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.checkpoint.integrity import RunIntegrity
from tracking3d.checkpoint.progress import SavedState
from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.refinement_writer import clear_refinement, undo_taking_over
from tracking3d.results.run_reader import FormatError

_log = logging.getLogger(__name__)


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
