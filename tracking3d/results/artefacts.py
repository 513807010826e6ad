"""The files that a finished run has, beside its estimates, and which of them are missing."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from tracking3d.errors import OutputError
from tracking3d.results import layout

PICTURES = (layout.OVERLAY, layout.CONTACT_SHEET)
_SHOWN = (layout.RUN, layout.FRAMES, *PICTURES, *layout.MESH_FILES)


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


def lacks_report(folder: Path) -> bool:
    """Whether a run has no report, or no turntable though it has a model."""
    model = (folder / layout.FEATURES).is_file()
    return bool(missing_files(folder, (layout.REPORT, *([layout.TURNTABLE] if model else []))))


def times_written(folder: Path) -> tuple[int, ...]:
    """When the files were written that a report shows; if one of them changes, the report is out of date."""
    paths = [folder / name for name in _SHOWN]
    return tuple(path.stat().st_mtime_ns if path.is_file() else 0 for path in paths)


def _is_there(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0
