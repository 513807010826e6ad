"""``tracking3d bench matching``: feature encoders by themselves."""

from __future__ import annotations

from tracking3d.cli.options import Debug


def matching(debug: Debug = False) -> None:
    """Measure feature encoders by themselves."""
