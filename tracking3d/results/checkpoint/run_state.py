"""Progress of a run: saved on disk every few steps, as long as the session's state can be saved."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.progress import JournalEntry, RunProgress, SavedState
from tracking3d.results.checkpoint.serialization import NotSerializableError

_log = logging.getLogger(__name__)

SAVED_EVERY = 10
"""Steps from one saved state to the next; at most so many frames are computed again after a kill."""


class RunState:
    """The state of one run, and of the stopped run that it resumes.

    Args:
        checkpoint: The checkpoint; None if it is of no use, since the source cannot be read again.
        kept: The state of the stopped run; None if there is none.

    Attributes:
        checkpoint: As given; None once the state turns out not to be serializable.
        kept: As given.
        before: How far the stopped run was.
        progress: How far the run is now.
    """

    def __init__(self, checkpoint: Checkpoint | None = None, kept: SavedState | None = None) -> None:
        self.checkpoint, self.kept = checkpoint, kept
        self.progress = self.before = kept.progress if kept else RunProgress()
        self._past = {*kept.taken, *(one.index for one in kept.skipped)} if kept else set()
        self._steps = 0
        self._unsaved: dict[str, Any] | None = None
        self._revised: set[int] = set()

    def has(self, index: int) -> bool:
        """Whether the stopped run has had frame ``index``."""
        return index in self._past

    def advance(
        self,
        session: dict[str, Any],
        taken: JournalEntry | None = None,
        revised: Iterable[int] = (),
        **changes: Any,
    ) -> None:
        """Take one step; the state is saved after the first one, then after every `SAVED_EVERY`-th.

        It is saved at once if earlier frames have other estimates: their masks are written over, and an earlier state
        would be of masks that are gone.

        Args:
            session: The session's state.
            taken: The frame that was taken for the first time, if it was one.
            revised: Earlier frames that have other estimates since then.
            changes: What is new in `progress`.

        Raises:
            OutputError: If it cannot be written.
        """
        self.progress = replace(self.progress, **changes)
        if self.checkpoint is None:
            return
        if taken is not None:
            self.checkpoint.note(taken)
        self._unsaved = session
        self._revised.update(revised)
        if self._revised or self._steps % SAVED_EVERY == 0 or self.checkpoint.rollback_point_due:
            self.save()
        self._steps += 1

    def save(self, session: dict[str, Any] | None = None, **changes: Any) -> None:
        """Save the state now.

        Args:
            session: The session's state; that of the last step if None.
            changes: What is new in `progress`.

        Raises:
            OutputError: If it cannot be written.
        """
        self.progress = replace(self.progress, **changes)
        session = self._unsaved if session is None else session
        if self.checkpoint is None or session is None:
            return
        self._unsaved = None
        try:
            self.checkpoint.save(self.progress, session, self._revised)
        except NotSerializableError as error:
            _log.warning("This run cannot be resumed when it is stopped: %s.", error)
            self.checkpoint.remove()
            self.checkpoint = None
        self._revised.clear()
