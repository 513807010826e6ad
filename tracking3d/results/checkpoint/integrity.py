"""Which frames of a run are whole on the disk: their lines in ``frames.jsonl``, and their masks.

A kill tears nothing, since masks are renamed into place before their line is written. A power cut can: files may then
be shorter than they were, empty, or filled with NUL bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d.results.checkpoint.progress import JournalEntry, RunProgress
from tracking3d.results.files import read_mask
from tracking3d.results.mesh_export import load_model
from tracking3d.results.records import FrameRecord, latest
from tracking3d.results.run_reader import LONGEST_LINE, RunReader
from tracking3d.video.image_file import silent_opencv


@dataclass(frozen=True, eq=False)
class WholeLines:
    """The lines of a ``frames.jsonl`` up to the first that is damaged."""

    records: tuple[FrameRecord, ...]  # what they say
    ends: tuple[int, ...]  # for each the bytes up to its end
    size: int  # bytes of the file

    @classmethod
    def of(cls, path: Path) -> WholeLines:
        """Read a file; if there is none, there are no lines."""
        records: list[FrameRecord] = []
        ends: list[int] = []
        if not path.is_file():
            return cls((), (), 0)
        with path.open("rb") as file:
            for line in iter(lambda: file.readline(LONGEST_LINE), b""):
                try:
                    record = FrameRecord.from_json(line)
                except ValueError:
                    break
                if not line.endswith(b"\n"):
                    break
                records.append(record)
                ends.append((ends[-1] if ends else 0) + len(line))
        return cls(tuple(records), tuple(ends), path.stat().st_size)

    @property
    def end(self) -> int:
        """Bytes of all of them."""
        return self.ends[-1] if self.ends else 0

    def until(self, end: int) -> Iterator[FrameRecord]:
        """Those within the first ``end`` bytes."""
        return (record for record, own in zip(self.records, self.ends, strict=True) if own <= end)


class RunIntegrity:
    """What is whole of a run that was stopped, or is finished.

    Args:
        folder: The run folder; nothing in it is changed.

    Attributes:
        lines: The whole lines of its ``frames.jsonl``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.lines = WholeLines.of(folder / layout.FRAMES)
        self._areas: dict[Path, int | None] = {}

    def of_state(self, progress: RunProgress, taken: Mapping[int, JournalEntry]) -> str:
        """What is damaged of the estimates that a saved state rests on, in words; empty if they are whole.

        Args:
            progress: The progress of that state.
            taken: Its frames.
        """
        if damage := _too_short(layout.FRAMES, self.lines, progress.lines):
            return damage
        causal = latest(self.lines.until(progress.lines), refined=False)
        if lost := sorted(taken.keys() - {record.index for record in causal}):
            return f"{layout.FRAMES} lacks frame {lost[0]}"
        corrections = [
            layout.mask_path(self._folder / layout.STATE, one.index)
            for one in taken.values()
            if one.corrected
        ]
        return (
            self._of_causal(causal)
            or self._first_damage((path, self._area(path) is not None) for path in corrections)
            or (self._of_refinement(progress) if progress.refining else "")
        )

    def of_finished(self, run: RunReader) -> str:
        """What is damaged of the estimates and the model of a finished run, in words; empty if they are whole."""
        if damage := _too_short(layout.FRAMES, self.lines, self.lines.size):
            return damage
        final = latest(self.lines.records)
        refined = [record for record in final if record.refined]
        for key, name, found in (("counts", "frames", final), ("refinement", "refined frames", refined)):
            number = (run.description.get(key) or {}).get("frames")
            if isinstance(number, int) and len(found) < number:
                return f"{layout.FRAMES} has {len(found)} of {number} {name}"
        return (
            self._of_causal(latest(self.lines.records, refined=False))
            or self._first_damage(self._of_masks(self._folder, refined))
            or self._of_model(self._folder)
        )

    def _of_causal(self, records: Sequence[FrameRecord]) -> str:
        """The first damaged mask of causal estimates, or initial mask."""
        causal, masks = self._folder / layout.CAUSAL, list[tuple[Path, bool]]()
        for record in records:
            aside = layout.mask_path(causal, record.index)
            masks += self._of_masks(causal if aside.is_file() else self._folder, [record])
            initial = layout.initial_mask_path(self._folder, record.index)
            if record.iou_initial is not None or initial.is_file():
                masks.append((initial, self._area(initial) is not None))
        return self._first_damage(masks)

    def _of_refinement(self, progress: RunProgress) -> str:
        """What is damaged of a final refinement so far; it may have been stopped while its masks were moved."""
        aside, causal = self._folder / layout.REFINING, self._folder / layout.CAUSAL
        lines = WholeLines.of(aside / layout.FRAMES)
        if damage := _too_short(f"{layout.REFINING}/{layout.FRAMES}", lines, progress.refined_lines):
            return damage
        masks = list[tuple[Path, bool]]()
        for record in latest(lines.until(progress.refined_lines)):
            replaced = layout.mask_path(causal, record.index).is_file()
            moved = replaced and not layout.mask_path(aside, record.index).is_file()
            masks += self._of_masks(self._folder if moved else aside, [record])
        model = causal if (causal / layout.FEATURES).is_file() else self._folder
        return self._first_damage(masks) or self._of_model(model)

    def _of_masks(self, folder: Path, records: Iterable[FrameRecord]) -> Iterator[tuple[Path, bool]]:
        """The mask of each estimate, and whether it is whole."""
        for record in records:
            path = layout.mask_path(folder, record.index)
            yield path, self._area(path) == record.area

    def _of_model(self, folder: Path) -> str:
        try:
            load_model(folder)
        except InputError:
            return f"{layout.FEATURES} or {layout.TEXTURE} is missing or damaged"
        return ""

    def _first_damage(self, files: Iterable[tuple[Path, bool]]) -> str:
        for path, whole in files:
            if not whole:
                return f"{path.relative_to(self._folder)} is missing or damaged"
        return ""

    def _area(self, path: Path) -> int | None:
        """Pixels of a mask; None if there is none that can be decoded."""
        if path not in self._areas:
            with silent_opencv():
                mask = read_mask(path)
            self._areas[path] = None if mask is None else int(np.count_nonzero(mask))
        return self._areas[path]


def _too_short(name: str, lines: WholeLines, needed: int) -> str:
    """What to say if a file has fewer bytes of whole lines than are needed."""
    if lines.end >= needed:
        return ""
    what = "is shorter than it was" if lines.size < needed else "is damaged"
    return f"{name} {what}"
