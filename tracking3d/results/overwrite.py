"""Clearing a folder for a run, only if it holds nothing but an earlier run."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError, OutputError
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.run_reader import FormatError, RunReader

_SYSTEM = frozenset(("desktop.ini", "Thumbs.db"))  # those of other systems begin with a dot


def check_run_folder(folder: Path, overwrite: bool) -> None:
    """Check that a run may go into a folder, before anything is written there; of an earlier run nothing is said.

    Raises:
        OutputError: If it is the root of a file system, or holds other files and ``overwrite`` is not set.
    """
    layout.refuse_root(folder)
    lines = folder / layout.FRAMES
    with writing(folder):
        if overwrite or not folder.is_dir():
            return
        if lines.is_symlink():  # they would be written elsewhere
            other: Path | None = lines
        elif layout.run_files(folder):
            return
        else:
            other = next((path for path in sorted(folder.iterdir()) if _is_foreign(path)), None)
    if other is not None:
        raise OutputError(
            f"{folder} holds something that is not a run's, such as {other.name}; choose another {layout.OUT}, or "
            f"pass {layout.OVERWRITE} to put the run beside it."
        )


def clear_run_folder(folder: Path, overwrite: bool) -> None:
    """Remove an earlier run from the folder, or refuse to.

    Only names within the folder are removed: of a link, the link and not what it leads to.

    Raises:
        OutputError: If there is one and ``overwrite`` is not set, or if files there are not a run's.
    """
    check_run_folder(folder, overwrite)
    there = _run_files(folder)
    if there and there != [layout.partial_path(folder / layout.RUN)]:  # else killed before anything was there
        _check_replaceable(folder, overwrite, there[0])
    remove_links(folder)
    with writing(folder):
        for path in _run_files(folder):
            # These two are replaced in place, so that a kill in between leaves a run folder.
            if path not in (folder / layout.RUN, folder / layout.FRAMES):
                path.unlink()


def _run_files(folder: Path) -> list[Path]:
    """Those of an earlier run; the file of lines is made before, to lock the folder."""
    return [path for path in layout.run_files(folder) if path.name != layout.FRAMES or path.stat().st_size]


def _check_replaceable(folder: Path, overwrite: bool, file: Path) -> None:
    try:
        has_frames = bool(RunReader(folder).frames)
    except FormatError:  # complete, but not readable by this version
        has_frames = True
    except InputError as error:
        raise OutputError(
            f"{folder} is not a readable run folder, but holds {file.relative_to(folder)}, which a run "
            f"would replace; choose another {layout.OUT}."
        ) from error
    if has_frames and not overwrite:
        raise OutputError(
            f"{folder} already holds a run; choose another {layout.OUT} or pass {layout.OVERWRITE}."
        )


def remove_links(folder: Path) -> None:
    """Remove links that bear the names of a run's files and folders; what they lead to stays as it is.

    Raises:
        OutputError: If one cannot be removed.
    """
    with writing(folder):
        for path in layout.run_folders(
            folder
        ):  # the outer ones first: what is within a linked one is elsewhere
            if path.is_symlink():
                path.unlink()
        for path in layout.top_files(folder):
            if path.is_symlink():
                path.unlink()


def _is_foreign(path: Path) -> bool:
    """Whether a file or folder is neither a run's nor hidden; an empty folder of a run is a run's."""
    folder = path.parent
    if path.name.startswith(".") or path.name in _SYSTEM or path in layout.top_files(folder):
        return False
    if path.stem == layout.PICKED or path.name == layout.PARTS:
        return False
    return path.is_symlink() or path not in layout.run_folders(folder) or any(path.iterdir())
