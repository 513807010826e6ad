"""Plug-ins by name: listed with their status, loaded, checked, and built from their options."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from tracking3d.config.explain import describe_validation_error, nearest, unknown_key
from tracking3d.config.models import PluginChoice
from tracking3d.errors import PluginError, Tracking3dError
from tracking3d.plugins.registration import (
    FEATURES,
    KEYPOINTS,
    KIND,
    TRACKERS,
    Registered,
    describe_exception,
    find_plugins,
    import_plugin,
)

_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    TRACKERS: (),
    FEATURES: ("channels", "stride", "tau"),
    KEYPOINTS: ("rotation_invariant",),
}
"""Attributes of an instance besides its methods; an encoder may know its channels only once it is built."""


_MASKS_GIVEN = "precomputed"
"""The tracker that needs masks, which come by an option of their own, and no weights."""


@dataclass(frozen=True)
class PluginInfo:
    """Description of one registered plug-in."""

    name: str  # the name that selects it
    group: str  # its entry-point group
    package: str  # the distribution that registers it, or TRACKING3D_PLUGINS
    # the distribution's version, or a short hash of the file of a module under development; empty if unknown
    version: str
    # duplicate means that another plug-in has the name already, needs weights that its network has to be
    # downloaded or named first
    status: Literal["ok", "broken", "duplicate", "needs weights"]
    reason: str = ""  # why the status is not ok
    options: dict[str, Any] | None = None  # JSON schema of its options, if the status is ok


def list_plugins(build: bool = False) -> list[PluginInfo]:
    """Every registered plug-in with its status; imports all of them, and reports those that fail.

    Args:
        build: Also build each with the options that it has by default, to see whether it can run.
    """
    infos = []
    first: dict[tuple[str, str], Registered] = {}
    for plugin in find_plugins():
        winner = first.setdefault((plugin.group, plugin.name), plugin)
        status: Literal["ok", "broken", "duplicate", "needs weights"] = "ok"
        reason, options = "", None
        if winner is not plugin:
            status, reason = "duplicate", f"the name is taken by the {winner.label}"
        else:
            try:
                options = import_plugin(plugin).Options.model_json_schema()
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                status, reason = "broken", describe_exception(error)
            if build and status == "ok" and plugin.name != _MASKS_GIVEN:
                try:
                    build_plugin(plugin.group, PluginChoice(name=plugin.name))
                except Tracking3dError as error:
                    status, reason = "needs weights", error.at_the_command_line
        infos.append(
            PluginInfo(plugin.name, plugin.group, plugin.package, plugin.version, status, reason, options)
        )
    return sorted(infos, key=lambda info: (info.group != TRACKERS, info.group, info.name))


def load_plugin(group: str, name: str) -> type[Any]:
    """The class of a plug-in.

    Args:
        group: ``TRACKERS``, ``FEATURES`` or ``KEYPOINTS``.
        name: The plug-in's name.

    Raises:
        PluginError: There is no plug-in of that name, it cannot be imported, or it does not follow the protocol.
    """
    return _load(_find(group, name))


def plugin_label(group: str, name: str) -> str:
    """Name of a plug-in in messages: ``mask tracker 'kcf' (tracking3d-kcf 0.1.0)``.

    Raises:
        PluginError: There is no plug-in of that name.
    """
    return _find(group, name).label


def check_options(group: str, choice: PluginChoice) -> BaseModel:
    """Validate the options of a chosen plug-in without building it.

    Returns:
        The plug-in's own ``Options`` with every default filled in.

    Raises:
        PluginError: As `load_plugin`; or an option is unknown, missing or out of range.
    """
    return _validate_options(_find(group, choice.name), choice)


def _validate_options(plugin: Registered, choice: PluginChoice) -> BaseModel:
    model: type[BaseModel] = _load(plugin).Options
    unknown = [key for key in choice.options if key not in model.model_fields]
    if unknown and model.model_config.get("extra", "ignore") == "ignore":  # pydantic would ignore it silently
        raise PluginError(f"{plugin.label}: {unknown_key(unknown[:1], model, 'option')}")
    try:
        return model.model_validate(choice.options)
    except ValidationError as error:
        raise PluginError(f"{plugin.label}: {describe_validation_error(error, model, 'option')}") from error


def build_plugin(group: str, choice: PluginChoice) -> Any:
    """Build the chosen plug-in from its options.

    Returns:
        A mask tracker, a feature encoder or a keypoint detector.

    Raises:
        PluginError: As `check_options`; or the plug-in fails while it is built.
    """
    plugin = _find(group, choice.name)
    options = _validate_options(plugin, choice)
    try:
        instance = _load(plugin).from_options(options)
    except Tracking3dError:
        raise
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise PluginError(f"{plugin.label} could not be started: {describe_exception(error)}.") from error
    if absent := [name for name in _ATTRIBUTES[group] if not hasattr(instance, name)]:
        raise PluginError(f"{plugin.label} is broken: it has no attribute {', '.join(absent)}.")
    return instance


def _find(group: str, name: str) -> Registered:
    plugins = [plugin for plugin in find_plugins(group) if plugin.group == group]
    for plugin in plugins:
        if plugin.name == name:
            return plugin
    installed = sorted({plugin.name for plugin in plugins})
    advice = advice_on_name(group, name)
    if not advice and (best := nearest(name, installed)):
        advice = f"did you mean '{best}'?"
    missing = f"There is no {KIND[group]} '{name}' (installed: {', '.join(installed) or 'none'})"
    raise PluginError(f"{missing}; {advice}" if advice else f"{missing}.")


def _load(plugin: Registered) -> type[Any]:
    try:
        return import_plugin(plugin)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # some extensions raise what is not an `Exception`
        raise PluginError(
            f"{plugin.label} is broken: {describe_exception(error)}; `tracking3d plugins` lists working plug-ins."
        ) from error


_SAM = (
    "MobileSAM is the plug-in tracking3d-sam (--tracker sam), or --tracker onnx with tracker.segmenter=mobile-sam, "
    "and masks of other programs are read with --masks"
)
_SAM2 = (
    "SAM 2 and EdgeTAM are the plug-in tracking3d-sam2 (--tracker sam2), which needs their package and weights, "
    "and masks of other programs are read with --masks"
)
_MASKS = "masks of other programs are read with --masks"
_U2NET = "that network runs in --tracker onnx with tracker.segmenter=u2netp"
_NETWORK = "that network runs in --features onnx with features.model=FILE.onnx"

_ADVICE: dict[str, dict[str, str]] = {
    TRACKERS: {
        **dict.fromkeys(("sam", "segmentanything", "mobilesam", "efficientsam", "fastsam"), _SAM),
        **dict.fromkeys(("sam2", "sam3", "edgetam"), _SAM2),
        **dict.fromkeys(("xmem", "cutie", "deva", "stm", "aot", "deaot", "stcn", "mask", "masks"), _MASKS),
        **dict.fromkeys(("u2net", "u2netp", "rembg"), _U2NET),
        **{name: f"it is the plug-in tracking3d-{name}" for name in ("d3s", "kcf", "nanotrack", "ostrack")},
        **dict.fromkeys(("csrdcf", "dcf"), "did you mean 'csrt'?"),
        **dict.fromkeys(("klt", "opticalflow", "lucaskanade", "raft"), "did you mean 'flow'?"),
        **dict.fromkeys(("best", "default"), "did you mean 'auto'?"),
    },
    FEATURES: {
        "aliked": "it is the plug-in tracking3d-aliked, or --features onnx with features.model=FILE.onnx",
        **dict.fromkeys(("alike", "xfeat", "superpoint"), _NETWORK),
        **dict.fromkeys(
            ("sift", "densesift", "disk", "hardnet", "hynet", "sosnet", "tfeat"),
            "kornia has it: --features kornia",
        ),
        **dict.fromkeys(("none", "color", "colour", "pixels", "image"), "did you mean 'rgb'?"),
    },
    KEYPOINTS: dict.fromkeys(("edgepoint", "edgepoint2"), "it is the plug-in tracking3d-edgepoint2"),
}
"""By group, and by name in small letters without hyphens and versions."""


def advice_on_name(group: str, name: str) -> str:
    """What to do instead of naming a plug-in that is not installed, as the end of a sentence; empty if unknown."""
    plain = re.sub("[^a-z0-9]", "", name.lower().partition(".")[0])
    advice = _ADVICE[group].get(plain, "")
    return advice if not advice or advice.endswith("?") else f"{advice}."
