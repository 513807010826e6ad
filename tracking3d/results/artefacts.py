"""The files that a finished run has, beside its estimates, and which of them are missing."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from tracking3d.errors import OutputError
from tracking3d.results import layout

PICTURES = (layout.OVERLAY, layout.CONTACT_SHEET)


def missing_files(folder: Path, names: Iterable[str]) -> list[str]:
    """Those of some files in a folder that are not there, or empty."""
    return [name for name in names if not _is_there(folder / name)]


def check_complete(folder: Path, *, mesh: bool, pictures: bool) -> None:
    """Make sure that a run that ends as finished has its files.

    Args:
        folder: The run folder.
        mesh: Whether it has a mesh.
        pictures: Whether a frame was drawn.

    Raises:
        OutputError: If one is missing.
    """
    names = [*(layout.MESH_FILES if mesh else ()), *(PICTURES if pictures else ())]
    if missing := missing_files(folder, names):
        verb = "is" if len(missing) == 1 else "are"
        raise OutputError(
            f"{', '.join(missing)} {verb} missing in {folder}, so that the run is not finished; resume it."
        )


def _is_there(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0
