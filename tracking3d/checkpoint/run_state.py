"""How far a run is: kept on disk after each step, as long as the session's state can be kept."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.checkpoint.progress import JournalEntry, Kept, RunProgress
from tracking3d.checkpoint.trees import UnkeptError

_log = logging.getLogger(__name__)


class RunState:
    """The state of one run, and of the stopped run that it resumes.

    Args:
        checkpoint: Where it is kept; None if that is of no use, since the source cannot be read again.
        kept: The state of the stopped run; None if there is none.

    Attributes:
        checkpoint: As given; None from the moment that the state turns out to be one that cannot be kept.
        kept: As given.
        before: How far the stopped run was.
        progress: How far the run is now.
    """

    def __init__(self, checkpoint: Checkpoint | None = None, kept: Kept | None = None) -> None:
        self.checkpoint, self.kept = checkpoint, kept
        self.progress = self.before = kept.progress if kept else RunProgress()
        self._past = {*kept.taken, *(one.index for one in kept.skipped)} if kept else set()

    def has(self, index: int) -> bool:
        """Whether the stopped run has had frame ``index``."""
        return index in self._past

    def save(
        self,
        session: dict[str, Any],
        taken: JournalEntry | None = None,
        revised: Iterable[int] = (),
        **changes: Any,
    ) -> None:
        """Keep the state after a step.

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
        try:
            self.checkpoint.save(self.progress, session, taken, revised)
        except UnkeptError as error:
            _log.warning("This run cannot be resumed when it is stopped: %s.", error)
            self.checkpoint.remove()
            self.checkpoint = None
