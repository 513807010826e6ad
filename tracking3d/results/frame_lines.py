"""The file ``frames.jsonl`` of a running run: complete lines and a single writer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tracking3d.errors import OutputError
from tracking3d.frames import SkippedFrame
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.lock import try_lock
from tracking3d.results.records import FrameRecord


@dataclass(frozen=True)
class WrittenSoFar:
    """What a stopped run has written."""

    lines: int = 0  # bytes of frames.jsonl that are of finished frames
    seconds: float = 0.0  # wall time of the run until then
    skipped: tuple[SkippedFrame, ...] = ()  # frames that were not taken


class FrameLines:
    """Appends records to ``frames.jsonl``, and holds a lock on it that the system drops with the process.

    Args:
        folder: The run folder; it exists.

    Raises:
        OutputError: If another run writes there, or the file cannot be opened.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / layout.FRAMES
        self._kept: int | None = None
        with writing(folder):
            self._new = not self._path.exists()
            self._file = self._path.open("ab", buffering=0)
        if not try_lock(self._file.fileno()):
            self._file.close()
            raise OutputError(
                f"{folder} is in use by another run; wait for it or choose another {layout.OUT}."
            )

    @property
    def size(self) -> int:
        """Bytes of finished frames."""
        return self._file.seek(0, 2) if self._kept is None else self._kept

    def begin(self) -> None:
        """Begin with none."""
        self._file.truncate(0)

    def go_on(self, kept: int) -> None:
        """Continue behind ``kept`` bytes; later lines stay until others are written in their place.

        Raises:
            OutputError: If the file is shorter.
        """
        if self._file.seek(0, 2) < kept:
            raise OutputError(f"{self._path} is shorter than it was; run it again with {layout.OVERWRITE}.")
        self._kept = kept

    def append(self, records: Sequence[FrameRecord]) -> None:
        """Append the lines of all records, or none of them.

        Raises:
            OutputError: If they cannot be written.
        """
        lines = b"".join(record.to_json().encode() + b"\n" for record in records)
        with writing(self._path):
            self.truncate()
            end = self._file.seek(0, 2)
            try:
                written = 0
                while written < len(lines):
                    written += self._file.write(lines[written:])
            except OSError:
                self._file.truncate(end)
                raise

    def truncate(self) -> None:
        """Cut off the lines that a stopped run wrote after its last finished frame."""
        if self._kept is not None:
            self._file.truncate(self._kept)
            self._kept = None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def discard(self) -> None:
        """Close the file, and remove it if it was made here."""
        self.close()
        if self._new:
            self._path.unlink()
