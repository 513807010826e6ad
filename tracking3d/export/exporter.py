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
"""Options of all formats."""


@dataclass(frozen=True)
class Exporter:
    """One format."""

    name: str  # what selects it
    kind: str  # what it is about: poses, cameras, masks, probabilities, points, model or scene
    writes: str  # what it writes, in a few words
    # writes a run to a path that does not exist yet: a file if there is a suffix, else a folder
    write: Callable[[ExportedRun, Path], object]
    suffix: str = ""  # suffix of the file; empty if a folder is written
    # Name of the file without its suffix in the folder of exports: {run} stands for the name of the run,
    # {letters} for the letters and digits of that name; the name of the run if this is empty. A folder has
    # the format's name.
    file_name: str = ""
    # names of those `ExportOptions` that it has a use for, besides `ANYWHERE`
    options: frozenset[str] = field(default=frozenset())
    modules: tuple[str, ...] = ()  # what has to be importable, besides what tracking3d always needs
    extra: str = ""  # what brings them: the name of an extra of this package

    def default_name(self, run: ExportedRun) -> str:
        """The name of the file or folder in the folder of exports of a run."""
        if not self.suffix:
            return self.name
        return (self.file_name or "{run}").format(
            run=run.title, letters=run.name.replace("-", "")
        ) + self.suffix

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
                f"The format {self.name} needs {' and '.join(self.modules)}, which is not installed; run "
                f"`pip install 'tracking3d[{self.extra}]'`."
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
                raise InputError(f"The format {self.name} does not use {label}; leave it out.")
