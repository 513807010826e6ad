"""Plug-ins registered by installed packages and by the environment variable, and how they are imported."""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from tracking3d.errors import PluginError, Tracking3dError

TRACKERS = "tracking3d.trackers"
"""Entry-point group of the mask trackers."""

FEATURES = "tracking3d.features"
"""Entry-point group of the feature encoders."""

KEYPOINTS = "tracking3d.keypoints"
"""Entry-point group of the keypoint detectors."""

VARIABLE = "TRACKING3D_PLUGINS"
"""Environment variable that registers plug-ins for development."""

KIND = {TRACKERS: "mask tracker", FEATURES: "feature encoder", KEYPOINTS: "keypoint detector"}
"""Word for a plug-in of each group."""

_METHODS = {
    TRACKERS: ("from_options", "init", "step"),
    FEATURES: ("from_options", "encode"),
    KEYPOINTS: ("from_options", "detect"),
}


@dataclass(frozen=True)
class Registered:
    """A registered plug-in that is not imported yet; ``value`` is ``module:Class``."""

    name: str
    group: str
    value: str
    package: str
    version: str

    @property
    def label(self) -> str:
        """Its name in messages: kind, name, package and version."""
        origin = f"{self.package} {self.version}".strip()
        return f"{KIND.get(self.group, 'plug-in')} '{self.name}' ({origin})"


def find_plugins(*groups: str) -> list[Registered]:
    """Registered plug-ins of the given groups, of all groups by default; imports none of them.

    Among plug-ins with the same name, the one that is used comes first. A single group takes half the time.
    """
    groups = groups or tuple(KIND)
    packaged = [plugin for group in groups for plugin in _packaged_plugins(group, _search_path())]
    packaged.sort(key=lambda plugin: (plugin.package != "tracking3d", plugin.package.lower()))
    return _from_environment() + packaged


def import_plugin(plugin: Registered) -> type[Any]:
    """Import the class and check it; raises whatever the plug-in raises, or `PluginError` with a clause as message."""
    if not plugin.value:
        raise PluginError("it is not of the form group:name=module:Class with a known group")
    module, _, attribute = plugin.value.rpartition(":")
    if module.endswith(".py"):
        cls = getattr(_module_from(Path(module)), attribute)
    else:
        cls = metadata.EntryPoint(plugin.name, plugin.value, plugin.group).load()
    if fault := _fault(plugin, cls):
        raise PluginError(fault)
    return cls


def describe_exception(error: BaseException) -> str:
    """An exception as one short line, without a full stop; it may come from code that cannot even describe it."""
    try:
        text = " ".join(str(error).split()).rstrip(".")
    except Exception as other:
        return f"{type(error).__name__}, which cannot be described because of {type(other).__name__}"
    if not isinstance(error, Tracking3dError):
        text = f"{type(error).__name__}: {text}"
    return text if len(text) <= 300 else text[:297] + "..."


def _search_path() -> tuple[tuple[str, int], ...]:
    """Folders that hold packages, and when each was last changed: installing a package changes it."""
    times = []
    for folder in sys.path:
        with suppress(OSError):
            times.append((folder, Path(folder).stat().st_mtime_ns))
    return tuple(times)


@functools.lru_cache(maxsize=8)
def _packaged_plugins(group: str, search_path: tuple[tuple[str, int], ...]) -> tuple[Registered, ...]:
    """The plug-ins of installed packages; cached, because reading all metadata is slow."""
    origin = functools.cache(_origin)
    points = metadata.entry_points(group=group)
    return tuple(Registered(point.name, group, point.value, *origin(point.dist)) for point in points)


def _origin(package: metadata.Distribution | None) -> tuple[str, str]:
    """Name and version of a package; its metadata may be damaged or absent."""
    try:
        return (package.name or "unknown", package.version or "") if package else ("unknown", "")
    except Exception:
        return "unknown", ""


def _from_environment() -> list[Registered]:
    items = [item.strip() for item in os.environ.get(VARIABLE, "").split(";") if item.strip()]
    plugins = []
    for item in items:
        head, _, value = item.partition("=")
        group, _, name = head.strip().rpartition(":")
        if group in KIND and name and ":" in value:
            version = _file_version(value.rpartition(":")[0])
            plugins.append(Registered(name, group, value, VARIABLE, version))
        else:  # stays in the list without a class, and is shown as broken
            plugins.append(Registered(item, group, "", VARIABLE, ""))
    return plugins


def _file_version(module: str) -> str:
    """Short hash of a module under development, in place of a version; empty if its file is not found."""
    file: Path | None = None
    if module.endswith(".py"):
        file = Path(module)
    else:
        with suppress(Exception):  # finding a module imports its parent packages
            spec = importlib.util.find_spec(module)
            file = Path(spec.origin) if spec and spec.origin else None
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()[:12] if file else ""
    except OSError:
        return ""


def _module_from(file: Path) -> Any:
    """Import a file once, under a name that cannot clash with another module."""
    name = f"_tracking3d_plugin_{file.stem}"
    known = sys.modules.get(name)
    if known and known.__file__ == str(file.resolve()):
        return known
    if not file.is_file():
        raise PluginError(f"the file {file} does not exist")
    spec = importlib.util.spec_from_file_location(name, file.resolve())
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # pydantic resolves postponed annotations here
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _fault(plugin: Registered, cls: Any) -> str:
    """Why the class is not a plug-in of its group; empty if it is."""
    if not isinstance(cls, type):
        return f"{plugin.value} is not a class"
    options = getattr(cls, "Options", None)
    if not (isinstance(options, type) and issubclass(options, BaseModel)):
        return "it has no nested pydantic model Options"
    if "name" in options.model_fields:
        return "its Options has a field 'name', which a configuration uses for the name of the plug-in"
    if absent := [name for name in _METHODS[plugin.group] if not callable(getattr(cls, name, None))]:
        return f"it has no method {', '.join(absent)}"
    why_unavailable = getattr(cls, "why_unavailable", None)
    return str(why_unavailable()) if callable(why_unavailable) else ""
