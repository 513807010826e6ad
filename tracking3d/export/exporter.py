"""What a format is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from tracking3d.errors import InputError
from tracking3d.export.options import ExportOptions

if TYPE_CHECKING:
    from tracking3d.export.exported_run import ExportedRun


ANYWHERE = frozenset({"answers"})
"""Options that every format knows."""


@dataclass(frozen=True)
class Exporter:
    """One format.

    Attributes:
        name: What selects it.
        kind: What it is about: ``poses``, ``cameras``, ``masks``, ``probabilities``, ``points``, ``model`` or
            ``scene``.
        writes: What it writes, in a few words.
        write: Writes a run to a path that does not exist yet: a file if there is a ``suffix``, else a folder.
        suffix: Of the file; empty where a folder is written.
        file_name: What it is called in the folder of exports, ``{run}`` standing for letters and digits of the run's
            name; empty for the format's name and suffix.
        options: Names of those `ExportOptions` that it has a use for, beside `ANYWHERE`.
        modules: What has to be importable, beside what tracking3d always needs.
        extra: What brings them: the name of an extra of this package.
    """

    name: str
    kind: str
    writes: str
    write: Callable[[ExportedRun, Path], object]
    suffix: str = ""
    file_name: str = ""
    options: frozenset[str] = field(default=frozenset())
    modules: tuple[str, ...] = ()
    extra: str = ""

    @property
    def is_available(self) -> bool:
        """Whether what it needs is installed."""
        return all(find_spec(module) is not None for module in self.modules)

    def check_available(self) -> None:
        """Make sure that what it needs is installed.

        Raises:
            InputError: If not; says what to install.
        """
        if not self.is_available:
            raise InputError(
                f"The format {self.name} needs {' and '.join(self.modules)}, not installed here; "
                f"run `pip install 'tracking3d[{self.extra}]'`."
            )

    def check_options(self, options: ExportOptions, named: dict[str, str]) -> None:
        """Make sure that no option was given that would have no effect.

        Args:
            options: What was asked.
            named: What sentences call each option.

        Raises:
            InputError: If one was.
        """
        defaults = ExportOptions()
        known = self.options | ANYWHERE
        for option, label in named.items():
            if option not in known and getattr(options, option) != getattr(defaults, option):
                raise InputError(f"The format {self.name} has no use for {label}; leave it out.")
