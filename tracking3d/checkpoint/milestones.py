"""Rollback points: saved states of earlier frames, from which a correction of a frame continues.

A rollback point is the state's text as it was after a frame; the files that it names stay. Its arrays are mostly those
of the states around it, so that few of them, spread evenly over the run, cost little.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

from tracking3d.results import layout
from tracking3d.results.files import link_or_copy

_FIRST_GAP = 4
"""Frames from one to the next in a short run; it is doubled whenever there are too many."""
_ARRAYS = re.compile(r'"file": "(\d{8,}\.npz)"')
_NAME = re.compile(r"milestone_(\d{6,})\.json")


@dataclass(frozen=True)
class Milestone:
    """The state after a frame."""

    taken: int  # how many frames were taken until then
    path: Path  # the file of its text
    arrays: frozenset[str]  # names of the array files that it needs

    @property
    def bytes(self) -> int:
        """Bytes of its text; arrays are shared."""
        return self.path.stat().st_size


class Milestones:
    """Those of one run, at most so many, spread evenly over its frames.

    Args:
        folder: The folder of the state.
        most: How many there may be; 0 for none.
    """

    def __init__(self, folder: Path, most: int) -> None:
        self._folder, self._most = folder, most
        self._kept: list[Milestone] = []
        self._refinement: Milestone | None = None
        self._gap = _FIRST_GAP

    def read(self, taken: int) -> None:
        """Read those of a run that is resumed after so many frames; later ones are removed."""
        self._kept = milestones_in(self._folder)
        self.forget_after(taken)
        start = self._folder / layout.REFINEMENT_START
        self._refinement = _read_milestone(start, taken) if start.is_file() else None
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
        self._kept.append(Milestone(taken, path, arrays))
        while len(self._kept) > self._most:
            self._gap *= 2
            self._drop([one for one in self._kept if one.taken % self._gap])

    def keep_refinement_start(self, state: Path, taken: int, arrays: frozenset[str]) -> None:
        """Keep the state as the final refinement begins, beside the rollback points; see `keep`."""
        path = self._folder / layout.REFINEMENT_START
        link_or_copy(state, path)
        self._refinement = Milestone(taken, path, arrays)

    def forget_after(self, taken: int) -> None:
        """Remove those after so many frames, since an earlier estimate has changed.

        Raises:
            OSError: If one cannot be removed.
        """
        self._drop([one for one in self._kept if one.taken > taken])

    def _drop(self, gone: list[Milestone]) -> None:
        for one in gone:
            one.path.unlink(missing_ok=True)
        self._kept = [one for one in self._kept if one not in gone]


def milestones_in(folder: Path) -> list[Milestone]:
    """The rollback points in the folder of a state, the earliest first."""
    found = []
    for path in sorted(folder.glob("milestone_*.json")) if folder.is_dir() else ():
        if name := _NAME.fullmatch(path.name):
            found.append(_read_milestone(path, int(name[1])))
    return sorted(found, key=lambda one: one.taken)


def _read_milestone(path: Path, taken: int) -> Milestone:
    text = path.read_text(encoding="ascii", errors="replace")
    return Milestone(taken, path, frozenset(_ARRAYS.findall(text)))


def keep_milestones_only(folder: Path, most_bytes: int) -> None:
    """Reduce the checkpoint in a run folder to its rollback points, and these to so many bytes.

    Args:
        folder: The run folder.
        most_bytes: Their largest size. Every second rollback point goes until the rest is no larger; the last one
            stays longest.

    Raises:
        OSError: If a file cannot be removed.
    """
    inner = folder / layout.STATE
    # The state first: without it nobody takes the run for one that was stopped.
    (inner / layout.STATE_FILE).unlink(missing_ok=True)
    kept = milestones_in(inner)
    while kept and _bytes(inner, kept) > most_bytes:
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


def _bytes(inner: Path, kept: list[Milestone]) -> int:
    names = {name for one in kept for name in one.arrays}
    sizes = [(inner / name).stat().st_size for name in names if (inner / name).is_file()]
    return sum(sizes) + sum(one.bytes for one in kept)
