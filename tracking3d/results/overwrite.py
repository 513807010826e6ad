"""Clearing a folder for a run, only if it holds nothing but an earlier run."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError, OutputError
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.run_reader import FormatError, RunReader

_SYSTEM = frozenset(("desktop.ini", "Thumbs.db"))  # those of other systems begin with a dot


def check_output_folder(folder: Path, overwrite: bool) -> None:
    """Check that a run may go into a folder, before anything is written there.

    An earlier run in it is accepted here: `clear_run_folder` asks whether it may be replaced.

    Raises:
        OutputError: If it is the root of a file system, or holds other files and ``overwrite`` is not set.
    """
    layout.refuse_root(folder)
    with writing(folder):
        if overwrite or not folder.is_dir():
            return
        lines = folder / layout.FRAMES
        linked = lines.is_symlink()  # it would be written through
        if not linked and layout.run_files(folder):
            return
        other = lines if linked else next(filter(_is_foreign, sorted(folder.iterdir())), None)
    if other is not None:
        raise OutputError(
            f"{folder} holds {other.name}, which is no part of a run; choose another {layout.OUT}, or pass "
            f"{layout.OVERWRITE} to write the run next to it."
        )


def clear_run_folder(folder: Path, overwrite: bool) -> None:
    """Remove an earlier run from the folder, or refuse to.

    Only names within the folder are removed: of a link, the link and not what it leads to.

    Raises:
        OutputError: If there is one and ``overwrite`` is not set, or if files there are not a run's.
    """
    check_output_folder(folder, overwrite)
    there = _run_files(folder)
    if there and there != [layout.partial_path(folder / layout.RUN)]:  # else killed before anything was there
        _check_replaceable(folder, overwrite, there[0])
    # These two are replaced in place, so that a kill in between leaves a run folder.
    kept = (folder / layout.RUN, folder / layout.FRAMES)
    with writing(folder):
        for inner in layout.run_folders(folder):  # outer ones first: what is in a linked one is elsewhere
            if inner.is_symlink():
                inner.unlink()
        for path in _run_files(folder):
            if path.is_symlink() or path not in kept:
                path.unlink()


def _run_files(folder: Path) -> list[Path]:
    """Those of an earlier run; the file of lines is made before, to lock the folder."""
    return [
        path
        for path in layout.run_files(folder)
        if path.name != layout.FRAMES or path.is_symlink() or path.stat().st_size
    ]


def _check_replaceable(folder: Path, overwrite: bool, file: Path) -> None:
    try:
        has_frames = _has_frames(RunReader(folder, whole=False))
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


def _has_frames(run: RunReader) -> bool:
    """Whether a run has estimates, readable or not."""
    try:
        return bool(run.frames)
    except InputError:
        return True


def _is_foreign(path: Path) -> bool:
    """Whether a visible file or folder is not a run's; an empty folder with the name of a run's is one of a run."""
    folder = path.parent
    if path.name.startswith(".") or path.name in _SYSTEM:
        return False
    if path.name == layout.INDEX and (folder / "object_0").is_dir():
        return False
    if path.is_symlink() or not path.is_dir():
        return path.is_symlink() or path.stem != layout.PICKED
    if path.name in (layout.PICKED, layout.PARTS) or layout.is_object_name(path.name):
        return False
    return path not in layout.run_folders(folder) or any(path.iterdir())
