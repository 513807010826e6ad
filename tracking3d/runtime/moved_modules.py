"""Modules that have moved are found under their former names for now, with a warning that names the present ones.

What measures is a distribution of its own, ``tracking3d-bench``. Nothing in this package imports it: only who still
imports a former name is led there.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import CodeType, ModuleType
from typing import Any

_ROOMS = {"benchmark", "datasets", "evaluation", "speed", "synthesis", "vot"}
"""Of the package, whose modules are in ``tracking3d_bench`` now."""

_MOVED_ROOMS = {
    "bundle_adjustment": "points.bundle_adjustment",
    "calibration": "geometry.calibration",
    "checkpoint": "results.checkpoint",
    "networks": "features.networks",
    "picker": "ui.picker",
    "prompts": "trackers.prompts",
    "report": "ui.report",
    "segmentation": "estimation.segmentation",
    "submaps": "pipeline.submaps",
    "viewer": "ui.viewer",
    "web": "ui.web",
}
"""Former rooms of the package, and where they are in it now."""

_ELSEWHERE = {
    "tracking3d.config.solvers": "tracking3d.config.models",
    "tracking3d.datasets.region_files": "tracking3d.trackers.region_files",
    "tracking3d.datasets.region_tracker": "tracking3d.trackers.region_tracker",
    "tracking3d.speed.kernels_ahead": "tracking3d.runtime.kernels_ahead",
} | {
    f"tracking3d.synthesis.{name}": f"tracking3d.testing.synthesis.{name}"
    for name in ("convex_clips", "convex_raycast", "procedural_texture")
}


def bench_is_missing(what: str) -> str:
    """A sentence for who asks for a part of the distribution ``tracking3d-bench`` without having it."""
    return (
        f"{what} is part of tracking3d-bench, which is not installed; in a clone of the repository run "
        "`pip install -c constraints.txt ./plugins/tracking3d-bench`."
    )


class MovedModules:
    """Finds what no other finder does: modules of this package that have moved.

    It derives from nothing, and neither do the loaders: `importlib.abc` takes longer to import than this package.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Where a former name leads; None for every other name."""
        package, _, inside = fullname.partition(".")
        room, _, rest = inside.partition(".")
        if package != "tracking3d" or not (room in _ROOMS | _MOVED_ROOMS.keys() or fullname in _ELSEWHERE):
            return None
        if inside == room and room != "vot":
            return ModuleSpec(fullname, _FormerRoom(), is_package=True)  # type: ignore[arg-type]
        within = room in _MOVED_ROOMS and f"tracking3d.{_MOVED_ROOMS[room]}.{rest}"
        present = _ELSEWHERE.get(fullname) or within or f"tracking3d_bench.{inside}"
        # Trackers of the VOT toolkit are named in its users' files, who see no DeprecationWarning.
        kind = FutureWarning if room == "vot" else DeprecationWarning
        warnings.warn(f"{fullname} has moved: use {present}.", kind, stacklevel=2)
        return ModuleSpec(fullname, _Moved(present))  # type: ignore[arg-type]


class _FormerRoom:
    """An empty package, whose modules `MovedModules` finds."""

    def create_module(self, spec: ModuleSpec) -> None:
        """As Python makes every module."""

    def exec_module(self, module: ModuleType) -> None:
        """There is nothing in it."""


class _Moved:
    """Gives the module ``present`` under another name."""

    def __init__(self, present: str) -> None:
        self._present = present
        self._own: ModuleSpec | None = None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The module itself, not a second one."""
        try:
            module = import_module(self._present)
        except ModuleNotFoundError as error:
            if error.name != "tracking3d_bench":
                raise
            raise ModuleNotFoundError(bench_is_missing(spec.name), name=spec.name) from error
        self._own = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """It has been executed; only its specification was replaced with that of the former name."""
        module.__spec__ = self._own

    def get_code(self, fullname: str) -> CodeType | None:
        """For ``python -m``."""
        from importlib.util import find_spec

        spec = find_spec(self._present)
        loader: Any = spec and spec.loader
        return loader and loader.get_code(self._present)


def find_moved_modules() -> None:
    """Let former names be imported from now on."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())
