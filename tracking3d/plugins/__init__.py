"""Mask trackers, feature encoders and keypoint detectors as plug-ins: found by entry point, checked, and built.

A plug-in is a class with a nested pydantic model ``Options``, a classmethod ``from_options(options)`` and the
methods of its protocol (`tracking3d.trackers.protocol`, `tracking3d.features.protocol`). Packages register it
under the entry-point group ``tracking3d.trackers``, ``tracking3d.features`` or ``tracking3d.keypoints``; the built-in
ones do the same.

For development, the environment variable ``TRACKING3D_PLUGINS`` registers plug-ins without a package. It
holds items ``group:name=module:Class`` separated by ``;``, where ``module`` is importable or the path of
a ``.py`` file::

    TRACKING3D_PLUGINS="tracking3d.trackers:mine=./my_tracker.py:MyTracker;tracking3d.features:lab=my.lab:Lab"

If several plug-ins have the same name, the first is used and the others are listed as duplicates: those of the
variable come first, then this package's own, then the others by package name.
"""

from tracking3d.plugins.registration import FEATURES, KEYPOINTS, TRACKERS, VARIABLE
from tracking3d.plugins.registry import (
    PluginInfo,
    build_plugin,
    check_options,
    list_plugins,
    load_plugin,
    plugin_label,
)

__all__ = [
    "FEATURES",
    "KEYPOINTS",
    "TRACKERS",
    "VARIABLE",
    "PluginInfo",
    "build_plugin",
    "check_options",
    "list_plugins",
    "load_plugin",
    "plugin_label",
]
