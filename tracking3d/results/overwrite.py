"""Clearing a folder for a run, only if it holds nothing but an earlier run."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError, OutputError
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.run_reader import FormatError, RunReader


def clear_run_folder(folder: Path, overwrite: bool) -> None:
    """Remove an earlier run from the folder, or refuse to.

    Raises:
        OutputError: If there is one and ``overwrite`` is not set, or if files there are not a run's.
    """
    there = [path for path in layout.run_files(folder) if path.name != layout.FRAMES or path.stat().st_size]
    unfinished = layout.partial_path(folder / layout.RUN)
    if there == [unfinished]:  # killed before anything was there
        with writing(folder):
            unfinished.unlink()
        return
    if not there:
        return
    try:
        has_frames = _has_frames(RunReader(folder))
    except FormatError:  # complete, but not readable by this version
        has_frames = True
    except InputError as error:
        raise OutputError(
            f"{folder} is not a readable run folder, but holds {there[0].relative_to(folder)}, which a run "
            f"would replace; choose another {layout.OUT}."
        ) from error
    if has_frames and not overwrite:
        raise OutputError(
            f"{folder} already holds a run; choose another {layout.OUT} or pass {layout.OVERWRITE}."
        )
    with writing(folder):
        for path in there:
            # These two are replaced in place, so that a kill in between leaves a run folder.
            if path not in (folder / layout.RUN, folder / layout.FRAMES):
                path.unlink()


def _has_frames(run: RunReader) -> bool:
    """Whether a run has estimates, readable or not."""
    try:
        return bool(run.frames)
    except InputError:
        return True
