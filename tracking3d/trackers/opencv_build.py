"""Which OpenCV is installed: several wheels provide the module ``cv2``, and not all contain what trackers need."""

from __future__ import annotations

from importlib import metadata
from operator import attrgetter

import cv2

CONTRIB = "opencv-contrib-python-headless"
"""The wheel that tracking3d requires."""

_WHEELS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", CONTRIB)


def why_no_contrib(*names: str) -> str:
    """Why parts of OpenCV's contrib modules cannot be used, and which wheels to remove and install.

    Args:
        *names: What is needed of ``cv2``, such as ``TrackerCSRT`` or ``ximgproc.fastGlobalSmootherFilter``.

    Returns:
        A clause without a full stop; empty if all is there.
    """
    absent = [name for name in names if not _has(name)]
    if not absent:
        return ""
    installed = [wheel for wheel in _WHEELS if _is_installed(wheel)]
    remove = f"`pip uninstall -y {' '.join(installed)}`, then " if installed else ""
    return f"the installed OpenCV lacks {', '.join(absent)}: {remove}`pip install {CONTRIB}`"


def _has(name: str) -> bool:
    try:
        attrgetter(name)(cv2)
    except AttributeError:
        return False
    return True


def _is_installed(wheel: str) -> bool:
    try:
        metadata.distribution(wheel)
    except metadata.PackageNotFoundError:
        return False
    return True
