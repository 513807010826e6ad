"""A run is corrected in a copy within its folder, which takes its place when it is finished, and not before.

Until then the run is as it was, whatever ends the correction. A kill while the copy takes its place leaves the rest
of that to the next call.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import ExitStack
from itertools import count
from pathlib import Path
from typing import Any

from tracking3d.checkpoint.resuming import Earlier, changed_frames, earlier_run
from tracking3d.checkpoint.rollback import remove_empty, remove_run, roll_back
from tracking3d.errors import InputError, OutputError
from tracking3d.results import layout
from tracking3d.results.files import writing
from tracking3d.results.lock import is_locked, try_lock
from tracking3d.results.run_reader import RunReader, is_finished, replacement_has_begun
from tracking3d.results.run_unit import complete_scaling

_log = logging.getLogger(__name__)


def stage_correction(
    folder: Path,
    config: Mapping[str, Any],
    selection: str | None,
    given: Mapping[str, Any],
    ends: ExitStack,
) -> tuple[Path, Earlier]:
    """The folder in which a corrected run is computed: from the last state before the correction, if one was saved.

    A finished run that is damaged is computed again in the same way, from the last state of which all is whole.

    Args:
        folder: The run folder.
        config: See `tracking3d.checkpoint.resuming.earlier_run`.
        selection: See there.
        given: See there.
        ends: When it is left, the corrected run, if it is finished, takes the place of the other one.

    Returns:
        A folder within, and what is in it: ``none``, ``stopped``, or ``finished`` if only the shape of its model is
        to be reconstructed, see `keeps_shape`.

    Raises:
        OutputError: If the run is being corrected at this moment, or something cannot be written.
        InputError: If it is damaged.
    """
    stage = folder / layout.CORRECTING
    if is_locked(stage / layout.FRAMES):
        raise OutputError(f"{folder} is being corrected at this moment; wait for that.")
    ends.callback(take_over, folder)
    lock = ends.enter_context((folder / layout.FRAMES).open("rb"))
    if not try_lock(lock.fileno()):
        raise OutputError(f"{folder} is in use by another run; wait for it.")
    there = _earlier_correction(stage, config, selection, given)
    if there in ("stopped", "finished"):
        _log.info("Continuing what was begun in %s.", stage)
        return stage, there
    remove_run(stage)
    changed = changed_frames(folder, given)
    estimated = roll_back(folder, stage, changed)
    if estimated is None:
        _log.warning(
            "No checkpoint%s is saved in %s, so that all frames are computed again%s.",
            f" before frame {min(changed)}" if changed else "",
            folder,
            "; frames before the correction get the estimates that they had" if changed else "",
        )
        return stage, "none"
    return stage, "stopped"


def keeps_shape(folder: Path) -> bool:
    """Whether the shape of a run's model was reconstructed after tracking, and is to be when the run is corrected.

    Raises:
        InputError: If it is no run.
    """
    wanted = RunReader(folder).config.get("object", {}).get("shape") == "fine"
    return wanted or (folder / layout.ONLINE / layout.FEATURES).is_file()


def take_over(folder: Path) -> None:
    """Replace a run by its corrected run, if that is finished, its model included.

    What was exported of the run as it was is kept in `layout.EXPORT_BEFORE`. A scaling that was interrupted is
    completed, too.

    Raises:
        OutputError: If a file cannot be moved.
    """
    stage = folder / layout.CORRECTING
    try:
        complete_scaling(folder)
        begun = replacement_has_begun(folder)
        if not is_finished(stage) or is_locked(stage / layout.FRAMES):
            return
        if not begun and keeps_shape(folder) and "shape" not in RunReader(stage).description:
            return
    except InputError:  # damaged: the next correction makes it again
        return
    with writing(folder):
        new = [path.relative_to(stage) for path in layout.run_files(stage)]
        if not begun:
            old = {path.relative_to(folder) for path in layout.run_files(folder)}
            gone = {path for path in old if path.parts[0] != layout.CORRECTING} - set(new)
            for path in gone:
                (folder / path).unlink(missing_ok=True)
            for inner in {path.parent for path in gone} - {Path()}:
                remove_empty(folder / inner)
            _set_export_aside(folder)
        # The lines first, which say that it was begun; the description last, which says that it is not done.
        order = {Path(layout.FRAMES): 0, Path(layout.RUN): 2}
        for path in sorted(new, key=lambda one: order.get(one, 1)):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (stage / path).replace(folder / path)
            (stage / path).unlink(missing_ok=True)  # of two names of one file nothing is renamed
    remove_empty(stage)


def _set_export_aside(folder: Path) -> None:
    """Give what was exported another name, since it shows the run as it was."""
    if not (folder / layout.EXPORT).is_dir():
        return
    names = (layout.EXPORT_BEFORE + (f"_{number}" if number > 1 else "") for number in count(1))
    (folder / layout.EXPORT).rename(next(folder / name for name in names if not (folder / name).exists()))


def _earlier_correction(
    stage: Path, config: Mapping[str, Any], selection: str | None, given: Mapping[str, Any]
) -> Earlier:
    """How far the same correction came before it was stopped: ``stopped`` or ``finished``; ``none`` for another one."""
    try:
        earlier = earlier_run(stage, config, selection, given)
    except (InputError, OutputError):
        return "none"
    return "none" if earlier == "stopped" and not layout.has_state(stage) else earlier
