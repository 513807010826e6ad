"""The description of an export format, and the options of an export."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.export.exported_run import ExportedRun

Answers = Literal["final", "causal"]
Of = Literal["object", "camera"]


@dataclass(frozen=True)
class ExportOptions:
    """What may be asked of an export; a format that has no use for an option refuses it.

    Attributes:
        answers: ``final`` takes the estimates of the final refinement if there are any, ``causal`` those before it.
        object_size: Metres of the longest side of the smallest box around the object; None leaves the run's unit.
        fps: Frames per second; None takes what the run knows.
        source: The video, where it is no longer where the run found it.
        of: ``object`` for poses ``T_cam_obj``, ``camera`` for those of a camera about the still object, ``T_obj_cam``.
        cut_out: Pictures as PNG that are transparent around the object, instead of whole ones with masks beside.
        images: Whether pictures are written where a format has room for them.
        undistorted: Masks and pictures as a camera without the distortion of the lens sees them, instead of as they
            were taken.
        frame: The frame that ``xy`` is in; None takes the first one with a pose.
        xy: Pixels on the object whose surface points are followed; empty for a grid over the object.
    """

    answers: Answers = "final"
    object_size: float | None = None
    fps: float | None = None
    source: str | None = None
    of: Of = "object"
    cut_out: bool = False
    images: bool = True
    undistorted: bool = False
    frame: int | None = None
    xy: tuple[tuple[float, float], ...] = ()


ANYWHERE = frozenset({"answers"})
"""Options of all formats."""


@dataclass(frozen=True)
class Exporter:
    """One format.

    Attributes:
        name: What selects it.
        kind: What it is about: ``poses``, ``cameras``, ``masks``, ``probabilities``, ``points``, ``model`` or
            ``scene``.
        writes: What it writes, in a few words.
        write: Writes a run to a path that does not exist yet: a file if there is a ``suffix``, else a folder.
        suffix: Of the file; empty if a folder is written.
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
