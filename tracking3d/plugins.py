"""Mask trackers and feature encoders as plug-ins: found by entry point, checked, built from their options.

A plug-in is a class with a nested pydantic model ``Options``, a classmethod ``from_options(options)`` and the
methods of its protocol (`tracking3d.trackers.protocol`, `tracking3d.features.protocol`). Packages register it
under the entry-point group ``tracking3d.trackers`` or ``tracking3d.features``; the built-in ones do the same.

For development, the environment variable ``TRACKING3D_PLUGINS`` registers plug-ins without a package. It
holds items ``group:name=module:Class`` with ``;`` between them, where ``module`` is importable or the path of
a ``.py`` file::

    TRACKING3D_PLUGINS="tracking3d.trackers:mine=./my_tracker.py:MyTracker;tracking3d.features:lab=my.lab:Lab"

Of several plug-ins with one name the first counts and the others are listed as duplicates: those of the
variable come first, then this package's own, then the others by name of their package.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from tracking3d.config.explain import describe, nearest, unknown_key
from tracking3d.config.models import PluginChoice
from tracking3d.errors import PluginError, Tracking3dError

TRACKERS = "tracking3d.trackers"
"""Entry-point group of the mask trackers."""

FEATURES = "tracking3d.features"
"""Entry-point group of the feature encoders."""

VARIABLE = "TRACKING3D_PLUGINS"
"""Environment variable that registers plug-ins for development."""

_KIND = {TRACKERS: "mask tracker", FEATURES: "feature encoder"}
_METHODS = {TRACKERS: ("from_options", "init", "step"), FEATURES: ("from_options", "encode")}
_ATTRIBUTES: dict[str, tuple[str, ...]] = {TRACKERS: (), FEATURES: ("channels", "stride", "tau")}
"""What an instance has besides methods; an encoder may know its channels only once it is built."""


@dataclass(frozen=True)
class PluginInfo:
    """What is known about one registered plug-in.

    Attributes:
        name: The name that selects it.
        group: Its entry-point group.
        package: The distribution that registers it, or ``TRACKING3D_PLUGINS``.
        version: The distribution's version; empty where unknown.
        status: ``duplicate`` means that another plug-in took the name first.
        reason: Why the status is not ``ok``.
        options: JSON schema of its options where it is ``ok``.
    """

    name: str
    group: str
    package: str
    version: str
    status: Literal["ok", "broken", "duplicate"]
    reason: str = ""
    options: dict[str, Any] | None = None


@dataclass(frozen=True)
class _Registered:
    """A registered plug-in before anything of it is imported; ``value`` is ``module:Class``."""

    name: str
    group: str
    value: str
    package: str
    version: str

    @property
    def label(self) -> str:
        origin = f"{self.package} {self.version}".strip()
        return f"{_KIND.get(self.group, 'plug-in')} '{self.name}' ({origin})"


def list_plugins() -> list[PluginInfo]:
    """Every registered plug-in with its status; imports all of them, and none can stop it."""
    infos = []
    first: dict[tuple[str, str], _Registered] = {}
    for plugin in _registered():
        winner = first.setdefault((plugin.group, plugin.name), plugin)
        status: Literal["ok", "broken", "duplicate"] = "ok"
        reason, options = "", None
        if winner is not plugin:
            status, reason = "duplicate", f"the name is taken by the {winner.label}"
        else:
            try:
                options = _import(plugin).Options.model_json_schema()
            except (Exception, SystemExit) as error:
                status, reason = "broken", _told(error)
        infos.append(
            PluginInfo(plugin.name, plugin.group, plugin.package, plugin.version, status, reason, options)
        )
    return sorted(infos, key=lambda info: (info.group != TRACKERS, info.group, info.name))


def load_plugin(group: str, name: str) -> type[Any]:
    """The class of a plug-in.

    Args:
        group: ``TRACKERS`` or ``FEATURES``.
        name: The plug-in's name.

    Raises:
        PluginError: No plug-in of that name, or it cannot be imported or does not keep to the protocol.
    """
    return _load(_find(group, name))


def check_options(group: str, choice: PluginChoice) -> BaseModel:
    """Validate the options of a chosen plug-in without building it.

    Returns:
        The plug-in's own ``Options`` with every default filled in.

    Raises:
        PluginError: As `load_plugin`; or an option that is unknown, missing or out of range.
    """
    plugin = _find(group, choice.name)
    model: type[BaseModel] = _load(plugin).Options
    unknown = [key for key in choice.options if key not in model.model_fields]
    if unknown and model.model_config.get("extra", "ignore") == "ignore":  # in silence, as pydantic would
        raise PluginError(f"{plugin.label}: {unknown_key(unknown[:1], model, 'option')}")
    try:
        return model.model_validate(choice.options)
    except ValidationError as error:
        raise PluginError(f"{plugin.label}: {describe(error, model, 'option')}") from error


def build_plugin(group: str, choice: PluginChoice) -> Any:
    """Build the chosen plug-in from its options.

    Returns:
        A mask tracker or a feature encoder.

    Raises:
        PluginError: As `check_options`; or the plug-in fails while it is built.
    """
    options = check_options(group, choice)
    plugin = _find(group, choice.name)
    try:
        instance = _load(plugin).from_options(options)
    except Tracking3dError:
        raise
    except Exception as error:
        raise PluginError(f"{plugin.label} could not be started: {_told(error)}.") from error
    if absent := [name for name in _ATTRIBUTES[group] if not hasattr(instance, name)]:
        raise PluginError(f"{plugin.label} is broken: it has no attribute {', '.join(absent)}.")
    return instance


def _registered() -> list[_Registered]:
    """All registered plug-ins, those first that win over others of the same name."""
    packaged = [
        _Registered(point.name, group, point.value, *_distribution(point))
        for group in _KIND
        for point in metadata.entry_points(group=group)
    ]
    packaged.sort(key=lambda plugin: (plugin.package != "tracking3d", plugin.package.lower()))
    return _from_environment() + packaged


def _distribution(point: metadata.EntryPoint) -> tuple[str, str]:
    """Package and version behind an entry point; its metadata may be damaged or absent."""
    try:
        dist = point.dist
        return (dist.name or "unknown", dist.version or "") if dist else ("unknown", "")
    except Exception:
        return "unknown", ""


def _from_environment() -> list[_Registered]:
    items = [item.strip() for item in os.environ.get(VARIABLE, "").split(";") if item.strip()]
    plugins = []
    for item in items:
        head, _, value = item.partition("=")
        group, _, name = head.strip().rpartition(":")
        # An item of another form stays in the list without a class, to be shown as broken.
        form_ok = group in _KIND and name and ":" in value
        plugins.append(_Registered(name if form_ok else item, group, value if form_ok else "", VARIABLE, ""))
    return plugins


def _find(group: str, name: str) -> _Registered:
    plugins = [plugin for plugin in _registered() if plugin.group == group]
    for plugin in plugins:
        if plugin.name == name:
            return plugin
    installed = sorted({plugin.name for plugin in plugins})
    best = nearest(name, installed)
    advice = f"; did you mean '{best}'?" if best else "."
    raise PluginError(
        f"There is no {_KIND[group]} '{name}' (installed: {', '.join(installed) or 'none'}){advice}"
    )


def _load(plugin: _Registered) -> type[Any]:
    try:
        return _import(plugin)
    except (Exception, SystemExit) as error:
        raise PluginError(
            f"{plugin.label} is broken: {_told(error)}; `tracking3d plugins` lists those that work."
        ) from error


def _import(plugin: _Registered) -> type[Any]:
    """Import the class and check it; raises whatever the plug-in raises, or `PluginError` with a clause."""
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


def _module_from(file: Path) -> Any:
    """Import a file once, under a name that cannot hide another module."""
    name = f"_tracking3d_plugin_{file.stem}"
    known = sys.modules.get(name)
    if known and known.__file__ == str(file.resolve()):
        return known
    if not file.is_file():
        raise PluginError(f"the file {file} does not exist")
    spec = importlib.util.spec_from_file_location(name, file.resolve())
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # pydantic looks up postponed annotations here
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _fault(plugin: _Registered, cls: Any) -> str:
    """Why the class is no plug-in of its group, or nothing."""
    if not isinstance(cls, type):
        return f"{plugin.value} is not a class"
    options = getattr(cls, "Options", None)
    if not (isinstance(options, type) and issubclass(options, BaseModel)):
        return "it has no nested pydantic model Options"
    if "name" in options.model_fields:
        return "its Options has a field 'name', which is the plug-in's own name in a configuration"
    if absent := [name for name in _METHODS[plugin.group] if not callable(getattr(cls, name, None))]:
        return f"it has no method {', '.join(absent)}"
    return ""


def _told(error: BaseException) -> str:
    """An exception in one short line, without a full stop."""
    text = " ".join(str(error).split()).rstrip(".")
    if not isinstance(error, Tracking3dError):
        text = f"{type(error).__name__}: {text}"
    return text if len(text) <= 200 else text[:197] + "..."
