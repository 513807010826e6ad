"""A correction added to a run that is there: it is computed again from the last state before the corrected frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tracking3d.checkpoint.rolling_back import given_in
from tracking3d.checkpoint.staging import take_over
from tracking3d.config.models import PipelineConfig
from tracking3d.corrections import Correction, checked_corrections
from tracking3d.errors import InputError
from tracking3d.frames import SkippedFrame
from tracking3d.open_tracking import request_tracking
from tracking3d.prompts import PromptSet
from tracking3d.recording import RecordOptions, record_tracking
from tracking3d.results.given_masks import given_mask
from tracking3d.results.layout import runs_in
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_source import open_run_source


def correct_run(
    folder: Path | str,
    corrections: Iterable[Correction],
    *,
    source: str | Path | None = None,
    listener: Callable[[FrameRecord | SkippedFrame], None] = lambda frame: None,
) -> None:
    """Say what the object is in frames of a run, and compute again what depends on it, with the run's own settings.

    Frames before the correction keep their causal answers; those after it are answered anew, from the last state of
    before it that the run has kept, and then the final refinement takes all of them. This is done in a copy within the
    run folder, which takes the run's place when it is finished.

    Args:
        folder: The run folder of one object.
        corrections: What the object is; one of a frame that was corrected before replaces the earlier one.
        source: Where the video lies now; as the run has it if left out.
        listener: Is told of every frame, also of those that stay.

    Raises:
        InputError: If a correction cannot be used, the video is not there, or the run is of an earlier version that
            did not keep what it was begun with.
        Tracking3dError: What ends the computation; the run is then as it was, and the same call goes on.
    """
    folder = Path(folder)
    take_over(folder)
    run = RunReader(folder)
    given = given_in(run)
    try:
        config = PipelineConfig.model_validate(run.config)
    except ValidationError as error:
        raise InputError(
            f"The settings in {folder / 'run.json'} are of another version of tracking3d: {error.errors()[0]['msg']}; "
            "make the run anew, with the correction."
        ) from error
    [new] = checked_corrections(corrections)
    together = {one.frame: one for one in _earlier(folder, given)} | new
    request = request_tracking(
        open_run_source(run, source),
        config,
        PromptSet.of_one(**_prompt(folder, given), start_frame=given.get("start_frame")),
        together.values(),
        skip_damaged=True,
    )
    command, selection = (run.description.get(key) for key in ("command", "selection"))
    record_tracking(request, folder, RecordOptions(command, selection, resume=True), listener)


def object_folders_of(folder: Path, corrections: Iterable[Correction]) -> dict[Path, list[Correction]]:
    """Corrections by the run folder of the object that they are of.

    Args:
        folder: A run folder, or the folder with those of several objects.
        corrections: `Correction.object` counts these.

    Raises:
        InputError: If there is no such object.
    """
    folders = runs_in(folder)
    by_object = checked_corrections(corrections, len(folders))
    return {
        one: [replace(correction, object=0) for correction in theirs.values()]
        for one, theirs in zip(folders, by_object, strict=True)
        if theirs
    }


def _prompt(folder: Path, given: dict[str, Any]) -> dict[str, Any]:
    """What the object is in the first frame, as `PromptSet.of_one` takes it."""
    if given.get("points") is not None:
        return {"points": given["points"]}
    if given.get("mask") is not None:
        return {"mask": given_mask(folder, given["first_frame"])}
    return {} if given.get("box") is None else {"box": tuple(given["box"])}


def _earlier(folder: Path, given: dict[str, Any]) -> list[Correction]:
    """The corrections that the run has had."""
    found = []
    for one in given.get("corrections") or ():
        frame, box = one["frame"], one["box"]
        mask = None if one["mask"] is None else given_mask(folder, frame)
        found.append(Correction(frame, None if box is None else tuple(box), mask, points=one["points"]))
    return found
