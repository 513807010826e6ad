"""The checkpoint of a run on disk: one JSON file that is replaced whole, and the files that it names.

After a kill at any moment it is the state of a finished frame, not necessarily the last one: arrays and the journal are
written first, and a file that the state names is removed only once another state has taken its place.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import SkippedFrame
from tracking3d.results import layout
from tracking3d.results.checkpoint.progress import (
    JournalEntry,
    RunProgress,
    SavedState,
    journal_line,
    read_journal,
)
from tracking3d.results.checkpoint.serialization import TreeFolder
from tracking3d.results.files import link_or_copy, read_mask, write_atomic, write_mask, writing
from tracking3d.results.run_reader import FormatError

VERSION = 3
MOST_KEPT = 100 * 10**6
"""Bytes that rollback points may take in the folder of a run that is finished."""


class Checkpoint:
    """Saves the state of one run, in `layout.STATE` of its folder.

    Args:
        folder: The run folder.
        classes: See `TreeFolder`.
        device: See `TreeFolder`.
        rollback_points: Number of rollback points that may be saved, see `tracking3d.results.checkpoint.folder`.

    Raises:
        OutputError: If the folder cannot be written.
    """

    def __init__(
        self, folder: Path, classes: tuple[type, ...], device: str = "cpu", rollback_points: int = 0
    ) -> None:
        self._folder = folder / layout.STATE
        with writing(self._folder):
            self._folder.mkdir(exist_ok=True)
        self._trees = TreeFolder(self._folder, classes, device)
        self._rollback_points = RollbackPoints(self._folder, rollback_points)
        self._taken: dict[int, int] = {}  # number of frames taken up to each of them
        self._journal = 0
        self._waiting = b""
        self._is_new = False

    def note(self, frame: SkippedFrame | JournalEntry) -> None:
        """Note a frame that was taken for the first time, or skipped; it is written with the next state."""
        self._waiting += journal_line(frame)
        if isinstance(frame, JournalEntry):
            self._taken[frame.index] = len(self._taken) + 1
            self._is_new = True

    @property
    def rollback_point_due(self) -> bool:
        """Whether the state after the frame that was noted last is to be a rollback point."""
        return self._is_new and self._rollback_points.due(len(self._taken))

    def save(
        self,
        progress: RunProgress,
        session: dict[str, Any],
        revised: Iterable[int] = (),
    ) -> None:
        """Save the state after the frames that were noted.

        Args:
            progress: Progress of the run.
            session: The session's state.
            revised: Earlier frames whose estimates have changed since the state before: no correction can continue
                from between.

        Raises:
            OutputError: If it cannot be written; the state before is then still there.
            NotSerializableError: If the session holds an object that cannot be saved.
        """
        lines = self._waiting
        with writing(self._folder):
            tree = self._trees.text(session)
            if lines:
                with (self._folder / layout.JOURNAL).open("ab") as journal:
                    journal.truncate(self._journal)
                    journal.write(lines)
            length = self._journal + len(lines)
            head = {"version": VERSION, "journal": length, "progress": asdict(progress)}
            text = f'{json.dumps(head)[:-1]}, "session": {tree}}}\n'
            write_atomic(self._folder / layout.STATE_FILE, text.encode("ascii"))
            self._journal, self._waiting = length, b""
            self._rollback_points.forget_after(
                min((self._taken.get(one, 0) - 1 for one in revised), default=len(self._taken))
            )
            if self.rollback_point_due:
                self._rollback_points.keep(
                    self._folder / layout.STATE_FILE, len(self._taken), self._trees.arrays
                )
            self._is_new = False
            if progress.refining and progress.last_refined < 0:
                state = self._folder / layout.STATE_FILE
                self._rollback_points.keep_refinement_start(state, len(self._taken), self._trees.arrays)
            self._trees.tidy(self._rollback_points.arrays)

    def read(self, name: str = layout.STATE_FILE) -> SavedState:
        """Read the last saved state, or an earlier one.

        Args:
            name: The file of the state.

        Raises:
            InputError: If it is damaged.
            FormatError: If it was written by another version.
        """
        path = self._folder / name
        try:
            state = json.loads(path.read_bytes())
            if state["version"] != VERSION:
                raise FormatError(
                    f"{path} was written by another version of tracking3d (format {state['version']}); "
                    f"run it again with {layout.OVERWRITE}."
                )
            self._journal = int(state["journal"])
            journal = self._folder / layout.JOURNAL
            text = journal.read_bytes()[: self._journal] if self._journal else b""
            if len(text) < self._journal:
                raise ValueError(f"{journal.name} is too short")
            taken, skipped = read_journal(text)
            self._taken = {index: number for number, index in enumerate(taken, 1)}
            kept = SavedState(
                RunProgress(**state["progress"]), self._trees.read(state["session"]), taken, skipped
            )
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"{path} is damaged ({error}); run it again with {layout.OVERWRITE}.") from error
        return kept

    def earlier_states(self) -> list[str]:
        """File names of the states before the last one, for `read`; the latest first."""
        start = self._folder / layout.REFINEMENT_START
        earlier = [one.path.name for one in reversed(rollback_points_in(self._folder))]
        return [*([start.name] if start.is_file() else []), *earlier]

    def return_to(self, name: str) -> None:
        """Let an earlier state take the place of the last one; what is newer is removed by `remove_orphans`.

        Raises:
            OutputError: If it cannot be written.
        """
        with writing(self._folder):
            write_atomic(self._folder / layout.STATE_FILE, (self._folder / name).read_bytes())

    def remove_orphans(self) -> None:
        """Remove the files of a state that was not finished, after `read`.

        Raises:
            OutputError: If they cannot be removed.
        """
        with writing(self._folder):
            self._rollback_points.read(len(self._taken))
            self._trees.remove_orphans(self._rollback_points.arrays)

    def keep_correction(self, index: int, mask: NDArray[np.bool_]) -> None:
        """Save the mask ``(H, W)`` that was fed back to the mask tracker in frame ``index``.

        Raises:
            OutputError: If it cannot be written.
        """
        path = layout.mask_path(self._folder, index)
        with writing(path):
            path.parent.mkdir(exist_ok=True)
        write_mask(path, mask)

    def correction(self, index: int) -> NDArray[np.bool_]:
        """Read that mask.

        Raises:
            InputError: If it is missing or damaged.
        """
        mask = read_mask(path := layout.mask_path(self._folder, index))
        if mask is None:
            raise InputError(f"{path} is missing or damaged; run it again with {layout.OVERWRITE}.")
        return mask

    def remove(self) -> None:
        """Remove the checkpoint.

        Raises:
            OutputError: If it cannot be removed.
        """
        with writing(self._folder):
            # The state first: without it the rest is not read.
            files = layout.state_files(self._folder.parent)
            for path in sorted(files, key=lambda path: path.name != layout.STATE_FILE):
                path.unlink(missing_ok=True)
            _remove_empty(self._folder)


def finish_state(folder: Path, most: int | None = None) -> None:
    """Reduce the checkpoint of a finished run to its rollback points, if these are not too large.

    Args:
        folder: The run folder.
        most: Bytes that it may take; `MOST_KEPT` if None. Every second rollback point goes until the rest is no larger;
            the last one stays longest.

    Raises:
        OutputError: If something cannot be removed.
    """
    inner, most = folder / layout.STATE, MOST_KEPT if most is None else most
    with writing(inner):
        # The state first: without it nobody takes the run for one that was stopped.
        (inner / layout.STATE_FILE).unlink(missing_ok=True)
        kept = rollback_points_in(inner)
        while kept and _bytes(inner, kept) > most:
            thinner = kept[1::2] or ([] if len(kept) < 2 else kept[:1])
            for one in kept:
                if one not in thinner:
                    one.path.unlink()
            kept = thinner
        needed = {name for one in kept for name in one.arrays} | {one.path.name for one in kept}
        if kept:
            needed |= {layout.JOURNAL}
        for path in layout.state_files(folder):
            if not kept or (path.parent == inner and path.name not in needed):
                path.unlink(missing_ok=True)
        _remove_empty(inner)


def _remove_empty(inner: Path) -> None:
    for empty in (inner / layout.MASKS, inner):
        with suppress(OSError):
            empty.rmdir()


# Rollback points: saved states of earlier frames, from which a correction of a frame continues.
#
# A rollback point is the state's text as it was after a frame; the files that it names stay. Its arrays are mostly
# those of the states around it, so that few of them, spread evenly over the run, cost little.

_FIRST_GAP = 4
"""Frames from one to the next in a short run; it is doubled whenever there are too many."""
_ARRAYS = re.compile(r'"file": "(\d{8,}\.npz)"')
_NAME = re.compile(r"milestone_(\d{6,})\.json")


@dataclass(frozen=True)
class RollbackPoint:
    """The state after a frame."""

    taken: int  # how many frames were taken until then
    path: Path  # the file of its text
    arrays: frozenset[str]  # names of the array files that it needs

    @property
    def bytes(self) -> int:
        """Bytes of its text; arrays are shared."""
        return self.path.stat().st_size


class RollbackPoints:
    """Those of one run, at most so many, spread evenly over its frames.

    Args:
        folder: The folder of the state.
        most: How many there may be; 0 for none.
    """

    def __init__(self, folder: Path, most: int) -> None:
        self._folder, self._most = folder, most
        self._kept: list[RollbackPoint] = []
        self._refinement: RollbackPoint | None = None
        self._gap = _FIRST_GAP

    def read(self, taken: int) -> None:
        """Read those of a run that is resumed after so many frames; later ones are removed."""
        self._kept = rollback_points_in(self._folder)
        self.forget_after(taken)
        start = self._folder / layout.REFINEMENT_START
        self._refinement = _read_rollback_point(start, taken) if start.is_file() else None
        self._gap = math.gcd(*(one.taken for one in self._kept)) or _FIRST_GAP

    @property
    def arrays(self) -> frozenset[str]:
        """Names of the array files that any of them needs."""
        kept = [*self._kept, *([self._refinement] if self._refinement else [])]
        return frozenset().union(*(one.arrays for one in kept))

    def due(self, taken: int) -> bool:
        """Whether the state after so many frames is to be saved."""
        return self._most > 0 and taken % self._gap == 0

    def keep(self, state: Path, taken: int, arrays: frozenset[str]) -> None:
        """Keep the state that is in a file.

        Args:
            state: The file; it is replaced by another one for the next state, never written over.
            taken: How many frames were taken until then.
            arrays: Names of the array files that the state needs.

        Raises:
            OSError: If it cannot be written.
        """
        path = self._folder / f"milestone_{taken:06d}.json"
        link_or_copy(state, path)
        self._kept.append(RollbackPoint(taken, path, arrays))
        while len(self._kept) > self._most:
            self._gap *= 2
            self._drop([one for one in self._kept if one.taken % self._gap])

    def keep_refinement_start(self, state: Path, taken: int, arrays: frozenset[str]) -> None:
        """Keep the state as the final refinement begins, beside the rollback points; see `keep`."""
        path = self._folder / layout.REFINEMENT_START
        link_or_copy(state, path)
        self._refinement = RollbackPoint(taken, path, arrays)

    def forget_after(self, taken: int) -> None:
        """Remove those after so many frames, since an earlier estimate has changed.

        Raises:
            OSError: If one cannot be removed.
        """
        self._drop([one for one in self._kept if one.taken > taken])

    def _drop(self, gone: list[RollbackPoint]) -> None:
        for one in gone:
            one.path.unlink(missing_ok=True)
        self._kept = [one for one in self._kept if one not in gone]


def rollback_points_in(folder: Path) -> list[RollbackPoint]:
    """The rollback points in the folder of a state, the earliest first."""
    found = []
    for path in sorted(folder.glob("milestone_*.json")) if folder.is_dir() else ():
        if name := _NAME.fullmatch(path.name):
            found.append(_read_rollback_point(path, int(name[1])))
    return sorted(found, key=lambda one: one.taken)


def _read_rollback_point(path: Path, taken: int) -> RollbackPoint:
    text = path.read_text(encoding="ascii", errors="replace")
    return RollbackPoint(taken, path, frozenset(_ARRAYS.findall(text)))


def _bytes(inner: Path, kept: list[RollbackPoint]) -> int:
    names = {name for one in kept for name in one.arrays}
    sizes = [(inner / name).stat().st_size for name in names if (inner / name).is_file()]
    return sum(sizes) + sum(one.bytes for one in kept)
