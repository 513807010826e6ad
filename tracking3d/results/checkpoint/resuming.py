"""Whether a run folder holds a run that can be continued with the present request."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, OutputError
from tracking3d.frames import Frame, Prompt
from tracking3d.results import layout
from tracking3d.results.checkpoint.integrity import WholeLines
from tracking3d.results.checkpoint.progress import checksum, read_journal
from tracking3d.results.files import is_locked
from tracking3d.results.records import jsonable
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.corrections import Correction

Earlier = Literal["none", "stopped", "finished", "outdated"]
"""The run in a folder: nothing that could be resumed, a run that was stopped, one that is finished, or one in which an
estimated frame is now corrected."""


def prompt_record(
    first: Frame,
    prompt: Prompt | None,
    count: int | None,
    start_frame: int | None = None,
    corrections: Iterable[Correction] = (),
) -> dict[str, Any]:
    """The identity of a source and the object in it, for ``run.json``.

    Args:
        first: The first frame.
        prompt: The object in it.
        count: Number of frames, if known.
        start_frame: The frame from which it is tracked both ways; None if frames come in order of time.
        corrections: Prompts in later frames.
    """
    height, width = first.size
    mask = None if prompt is None or prompt.mask is None else checksum(prompt.mask.astype("uint8"))
    return {
        "start_frame": start_frame,
        "corrections": [_correction_record(one) for one in sorted(corrections, key=lambda one: one.frame)],
        "frames": count,
        "width": width,
        "height": height,
        "first_frame": first.index,
        "first_image_crc": checksum(first.image),
        "box": None if prompt is None else [float(value) for value in prompt.box],
        "mask": mask,
        "points": None if prompt is None or prompt.points is None else prompt.points.tolist(),
    }


def _correction_record(correction: Correction) -> dict[str, Any]:
    """A correction for ``run.json``."""
    mask, points = correction.mask, correction.points
    return {
        "frame": correction.frame,
        "box": None if correction.box is None else list(correction.box),
        "mask": checksum(mask.astype("uint8")) if isinstance(mask, np.ndarray) else None,
        "points": None if points is None else np.asarray(points).tolist(),
    }


_NAMES = {
    "start_frame": "frame to start from",
    "frames": "number of frames",
    "width": "width of the frames",
    "height": "height of the frames",
    "first_frame": "index of the first frame",
    "first_image_crc": "first image",
    "box": "object's box",
    "mask": "object's mask",
    "points": "object's points",
}
_CHECKSUMS = ("first_image_crc", "mask")


def earlier_run(
    folder: Path, config: Mapping[str, Any], selection: str | None, given: Mapping[str, Any]
) -> Earlier:
    """The run in a folder, as far as a run of these settings and this source can continue it.

    Args:
        folder: The run folder.
        config: The configuration, as JSON has it.
        selection: The ``START:STOP:STEP`` that the source was opened with.
        given: See `prompt_record`.

    Raises:
        InputError: If the run there has other settings or another source, or its state was not saved.
        OutputError: If it is running at this moment.
    """
    if not (folder / layout.RUN).is_file():
        return "none"
    run = RunReader(folder)
    if is_locked(folder / layout.FRAMES):
        raise OutputError(f"{folder} is in use by another run; wait for it or choose another {layout.OUT}.")
    finished = run.state == "finished"
    if not finished and not layout.has_state(folder):
        if len(_estimated(folder)) <= 1:  # stopped before the first state was saved
            return "none"
        raise InputError(
            f"The run {folder} cannot be resumed: its state was not saved; run it again with {layout.OVERWRITE}."
        )
    if what := next(_differences(run.description, config, selection, given), None):
        raise InputError(
            f"The run {folder} cannot be resumed with other settings or another source: {what}; "
            f"use the same settings and source, or run it again with {layout.OVERWRITE}."
        )
    changed = _changed(run.description, given)
    if changed and (finished or changed & _estimated(folder)):
        return "outdated"
    return "finished" if finished else "stopped"


def _estimated(folder: Path) -> set[int]:
    """The frames that have an estimate in a run, up to a damaged line, or will have that of the picture before."""
    estimated = {record.index for record in WholeLines.of(folder / layout.FRAMES).records}
    with suppress(OSError, ValueError):  # of a journal that is damaged an earlier state is taken
        _, skipped = read_journal((folder / layout.STATE / layout.JOURNAL).read_bytes())
        estimated |= {one.index for one in skipped if one.repeats is not None}
    return estimated


def changed_frames(folder: Path, given: Mapping[str, Any]) -> set[int]:
    """The frames of the run in a folder whose correction is new or differs.

    Raises:
        InputError: If the run is damaged.
    """
    return _changed(RunReader(folder).description, given)


def _changed(before: Mapping[str, Any], given: Mapping[str, Any]) -> set[int]:
    """Frames whose correction is new or differs."""
    then, now = _by_frame(before.get("prompt") or {}), _by_frame(given)
    return {frame for frame in now if then.get(frame) != now[frame]}


def _by_frame(given: Mapping[str, Any]) -> dict[int, Any]:
    return {one["frame"]: one for one in given.get("corrections") or ()}


def _differences(
    before: Mapping[str, Any], config: Mapping[str, Any], selection: str | None, given: Mapping[str, Any]
) -> Iterator[str]:
    """The differences, in words."""
    if before.get("selection") != selection:
        yield f"the selection of frames was {before.get('selection')} and is {selection}"
    then, now = _flat(_complete(before["config"])), _flat(jsonable(config))
    for key in sorted(then.keys() | now.keys()):
        if then.get(key) != now.get(key):
            yield f"{key} was {then.get(key)} and is {now.get(key)}"
    earlier = before.get("prompt") or {}
    if gone := sorted(_by_frame(earlier).keys() - _by_frame(given).keys()):
        yield f"it was corrected in {_frames(gone)}, which is not requested now"
    for key, name in _NAMES.items():
        if earlier.get(key) != given[key]:
            was = "is another one" if key in _CHECKSUMS else f"was {earlier.get(key)} and is {given[key]}"
            yield f"the {name} {was}"


def _complete(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The configuration, with the defaults of keys that were added since."""
    try:
        return PipelineConfig.model_validate(config).model_dump(mode="json")
    except ValidationError:  # newer, or edited by hand: the differences are reported
        return config


def _frames(indices: list[int]) -> str:
    return f"frame{'s' * (len(indices) > 1)} {', '.join(map(str, indices))}"


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """The leaves of nested mappings by their dotted keys."""
    if not isinstance(tree, Mapping):
        return {prefix: tree}
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
    return flat
