"""Finding a data set's files by patterns with placeholders; see `tracking3d_bench.datasets.layout`."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.video.source import natural_order


class _Value(str):
    """Fills ``{name}`` as it is and ``{name:06d}`` as a number."""

    def __format__(self, spec: str) -> str:
        return format(int(self), spec) if spec else str(self)


@dataclass(frozen=True)
class Place:
    """One sequence of a data set, and one object in it.

    Attributes:
        root: The data set's folder.
        sequence: Name of the sequence.
        object: The object's name or number; None if the sequence has only one.
    """

    root: Path
    sequence: str
    object: str | None = None

    @property
    def object_number(self) -> int:
        """The object as a number; 1 if the sequence has only one and no name for it.

        Raises:
            InputError: If its name is not a number.
        """
        try:
            return int(self.object or 1)
        except ValueError as error:
            raise InputError(
                f"The object '{self.object}' of the sequence '{self.sequence}' is not a number, but the "
                "description requires one; correct the description."
            ) from error

    def files(self, patterns: Iterable[str]) -> list[Path]:
        """The files of the first pattern that any file matches, in natural order."""
        for pattern in patterns:
            filled = self._fill(pattern)
            found = [path for path in self.root.glob(filled) if path.is_file()] if filled else []
            if found:
                return sorted(found, key=natural_order)
        return []

    def file(self, patterns: Iterable[str]) -> Path | None:
        """The first file of the first pattern that any file matches."""
        return next(iter(self.files(patterns)), None)

    def required(self, patterns: tuple[str, ...], what: str) -> Path:
        """Like `file`.

        Raises:
            InputError: If there is none; ``what`` says what it holds.
        """
        file = self.file(patterns)
        if file is None:
            wanted = " or ".join(self._fill(pattern) or pattern for pattern in patterns)
            raise InputError(
                f"The sequence '{self.sequence}' in {self.root} has no {wanted}, which holds its {what}; restore it."
            )
        return file

    def of_frame(self, patterns: Iterable[str], frame: int, instance: int | None) -> Path | None:
        """The existing file of one frame for patterns with ``{frame}`` and ``{instance}``."""
        more = {"frame": str(frame)} | ({} if instance is None else {"instance": str(instance)})
        filled = (self._fill(pattern, **more) for pattern in patterns)
        return next((self.root / path for path in filled if path and (self.root / path).is_file()), None)

    def objects(self, pattern: str) -> list[str]:
        """What ``{object}`` can be for ``pattern`` to name existing files or folders."""
        wild = replace(self, object="*")._fill(pattern)
        position = next(n for n, part in enumerate(Path(pattern).parts) if "{object}" in part)
        # The sequence's name may have more parts than its placeholder.
        from_end = len(Path(pattern).parts) - position
        before, _, after = Path(pattern).parts[position].partition("{object}")
        parts = [path.relative_to(self.root).parts for path in self.root.glob(wild or "")] if wild else []
        names = {part[-from_end].removeprefix(before).removesuffix(after) for part in parts}
        return [path.name for path in sorted(map(Path, names), key=natural_order)]

    def _fill(self, pattern: str, **more: str) -> str | None:
        """The pattern with its placeholders filled; None if one has no value here."""
        values = {"sequence": glob.escape(self.sequence), **more}
        if self.object is not None:
            values["object"] = self.object
        try:
            return pattern.format(**{name: _Value(value) for name, value in values.items()})
        except KeyError:
            return None
        except ValueError as error:
            raise InputError(
                f"The path {pattern} cannot be filled with {values} ({error}); correct the description."
            ) from error
