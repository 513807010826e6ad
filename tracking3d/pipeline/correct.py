"""A correction added to a run that is there: it is computed again from the last state before the corrected frame."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.open_tracking import request_tracking
from tracking3d.pipeline.record import RecordOptions, record_tracking
from tracking3d.reconstruction.rebuild import check_packages
from tracking3d.results import layout
from tracking3d.results.checkpoint.staging import keeps_shape, prompt_record_in, take_over
from tracking3d.results.files import read_given_mask
from tracking3d.results.layout import runs_in
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, open_run_source
from tracking3d.trackers.prompts.corrections import Correction, missing_frame_error, validate_corrections
from tracking3d.trackers.prompts.prompt import PromptSet


def correct_run(
    folder: Path | str,
    corrections: Iterable[Correction],
    *,
    source: str | Path | None = None,
    listener: Callable[[FrameRecord | SkippedFrame], None] = lambda frame: None,
) -> None:
    """Correct the object in frames of a run, and compute again what depends on it, with the run's own settings.

    Frames before the correction keep their causal estimates; those after it are estimated again, from the last
    checkpoint before it that the run has saved. The final refinement then takes the frames whose causal estimates have
    changed, unless these are most of the video. This is done in a copy within the run folder, which takes the run's
    place when it is finished; `replaced_by_correction` says what else is replaced.

    Args:
        folder: The run folder of one object.
        corrections: Prompts in later frames; one for a frame that was corrected before replaces the earlier one.
        source: The present path of the video; that in the run if left out.
        listener: Called for every frame, also for those that stay.

    Raises:
        InputError: If a correction cannot be used, the video is not there, or the run was written by an
            earlier version.
        Tracking3dError: The computation failed; the run is unchanged, and the same call continues the correction.
    """
    folder = Path(folder)
    take_over(folder)
    run = RunReader(folder)
    given = prompt_record_in(run)
    try:
        config = PipelineConfig.model_validate(run.config)
    except ValidationError as error:
        raise InputError(
            f"The settings in {folder / 'run.json'} are of another version of tracking3d: {error.errors()[0]['msg']}; "
            "run the video again, with the correction."
        ) from error
    [new] = validate_corrections(corrections)
    check_corrections(folder, new.values())
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
    """Corrections by the run folder of their object.

    Args:
        folder: A run folder, or the folder with those of several objects.
        corrections: `Correction.object` counts these.

    Raises:
        InputError: If there is no such object, or a correction does not say which of several objects it is for.
    """
    folders = runs_in(folder)
    by_object = validate_corrections(corrections, len(folders), [one.name for one in folders])
    return {
        one: [replace(correction, object=0) for correction in theirs.values()]
        for one, theirs in zip(folders, by_object, strict=True)
        if theirs
    }


def replaced_by_correction(folder: Path, report: bool = True) -> list[str]:
    """What a correction of a run replaces or removes apart from its estimates, in sentences to be shown before.

    Args:
        folder: The run folder of one object.
        report: Whether a report is written afterwards.

    Raises:
        InputError: If it is no run.
    """
    said = []
    if keeps_shape(folder):
        said.append(
            f"The shape of the model of {folder} is reconstructed again after the correction, unless few frames change."
        )
    if (folder / layout.EXPORT).is_dir():
        said.append(
            f"{folder / layout.EXPORT} shows the run as it is now and becomes {layout.EXPORT_BEFORE}; export the "
            "corrected run again with `tracking3d export`."
        )
    if (folder / layout.LANDMARKS).is_file():
        said.append(
            f"{folder / layout.LANDMARKS} is removed, since it belongs to the estimates as they are now; "
            "`tracking3d points` makes it again."
        )
    if not report and (folder / layout.REPORT).is_file():
        said.append(f"The report of {folder} is removed; `tracking3d report` writes it again.")
    return said


def check_corrections(folder: Path, corrections: Iterable[Correction]) -> None:
    """Make sure that a run has the frames that are to be corrected, and that its model can be made again.

    An earlier correction that is finished, and takes the run's place in part, takes it before.

    Args:
        folder: The run folder of one object.
        corrections: See `correct_run`.

    Raises:
        InputError: If it has not, or a package is missing for its model.
    """
    take_over(folder)
    run = RunReader(folder)
    _check_frames(run, corrections)
    if keeps_shape(folder):
        check_packages()


def _check_frames(run: RunReader, corrections: Iterable[Correction]) -> None:
    """Make sure that a run has estimates for the corrected frames; one that was stopped may have them later.

    Raises:
        InputError: It does not.
    """
    estimated = [record.index for record in run.frames]
    skipped = {one["index"]: one["reason"] for one in run.description.get("skipped") or ()}
    for one in corrections:
        if one.frame in skipped:
            raise InputError(
                f"{one.name} frame {one.frame} of the run {run.folder} has no estimate, because it could not be used "
                f"({skipped[one.frame]}); correct another frame."
            )
        if run.state == "finished" and one.frame not in estimated:
            raise missing_frame_error(one, estimated)


def _prompt(folder: Path, given: dict[str, Any]) -> dict[str, Any]:
    """What the object is in the first frame, as `PromptSet.of_one` takes it."""
    if given.get("points") is not None:
        return {"points": given["points"]}
    if given.get("mask") is not None:
        return {"mask": read_given_mask(folder, given["first_frame"])}
    return {} if given.get("box") is None else {"box": tuple(given["box"])}


def _earlier(folder: Path, given: dict[str, Any]) -> list[Correction]:
    """The corrections that the run has had."""
    found = []
    for one in given.get("corrections") or ():
        frame, box = one["frame"], one["box"]
        mask = None if one["mask"] is None else read_given_mask(folder, frame)
        found.append(Correction(frame, None if box is None else tuple(box), mask, points=one["points"]))
    return found
