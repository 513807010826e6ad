"""``tracking3d bench masks``: mask trackers by themselves."""

from __future__ import annotations

from tracking3d.cli.options import Debug


def masks(debug: Debug = False) -> None:
    """Measure mask trackers by themselves."""
