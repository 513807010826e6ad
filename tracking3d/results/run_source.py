"""The video of a run at its present path."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError
from tracking3d.results.run_reader import RunReader
from tracking3d.video import FrameSource, open_source


def open_run_source(run: RunReader, source: str | Path | None = None) -> FrameSource:
    """The video that a run was made on.

    Args:
        run: The run.
        source: Its present path; if left out that in the run, from the present folder or from those above the run's.

    Raises:
        InputError: If it is not there.
    """
    named = source if source is not None else run.description.get("source")
    if not isinstance(named, str | Path) or not str(named) or str(named).isdigit():
        raise InputError(f"The video of the run {run.folder} cannot be read again; give it as --source.")
    places = [Path(named)] if source is not None else places_of(str(named), run.folder)
    there = next((place for place in places if place.exists()), named)
    try:
        return open_source(str(there), run.description.get("selection"))
    except InputError as error:
        raise InputError(
            f"The video of the run {run.folder} cannot be read ({str(error).rstrip('.')}); give its path as --source."
        ) from error


def places_of(source: str, folder: Path) -> list[Path]:
    """Candidate paths of a run's video: its path was relative to the working directory of the run.

    Args:
        source: What ``run.json`` calls it.
        folder: The run folder.
    """
    name = Path(source).expanduser()
    return [name] if name.is_absolute() else [name, *(above / name for above in folder.resolve().parents)]
