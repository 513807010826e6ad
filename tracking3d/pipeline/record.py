"""From a source to run folders: every frame is estimated, and every estimate is written as soon as it exists."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.pipeline.frame_reading import read_again
from tracking3d.pipeline.known_object import select_camera
from tracking3d.pipeline.open_tracking import OpenTracking, TrackRequest, open_tracking, request_tracking
from tracking3d.pipeline.passes import Listener, first_pass, run_refinement, running
from tracking3d.pipeline.recorder import ObjectRecorder
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.validation import validate_folder
from tracking3d.reconstruction.final_shape import is_reconstructed, make_final_shape
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint, finish_state
from tracking3d.results.checkpoint.integrity import RunIntegrity
from tracking3d.results.checkpoint.progress import SavedState
from tracking3d.results.checkpoint.resuming import Earlier, earlier_run, prompt_record
from tracking3d.results.checkpoint.run_state import RunState
from tracking3d.results.checkpoint.staging import keeps_shape, read_intact_state, stage_correction, take_over
from tracking3d.results.description import RunHeader
from tracking3d.results.files import keep_given_masks
from tracking3d.results.layout import object_folders
from tracking3d.results.mesh_export import export_mesh, load_model, restore_texture
from tracking3d.results.overwrite import check_output_folder
from tracking3d.results.redrawing import redraw_contact_sheet, redraw_overlay
from tracking3d.results.run_reader import RunReader, is_finished
from tracking3d.results.run_unit import apply_object_size
from tracking3d.results.run_writer import PICTURES, RunWriter, WrittenSoFar, missing_files
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video.opening import without_repeats
from tracking3d.video.source import FrameSource, source_notes

__all__ = ["Listener", "RecordOptions", "record", "record_objects", "record_tracking"]


@dataclass(frozen=True)
class RecordOptions:
    """How a tracking is written into run folders.

    Attributes:
        command: The command line, for the record.
        selection: The ``START:STOP:STEP`` that the source was opened with, for the record.
        overwrite: Replace a run that is in the folder.
        resume: Continue the run that is in the folder from its last finished frame, or begin one if there is none. If
            files of it are damaged, it goes on from the last saved state of which all is whole. A finished run stays
            as it is, and what it lacks is made again. If a frame that has an estimate is corrected now, what depends
            on it is computed again from the last checkpoint before it, in a copy within the folder; until that is
            finished, the run stays as it is.
        first_pass_only: Stop when every frame has its causal estimate; ``resume`` continues from there.
    """

    command: str | None = None
    selection: str | None = None
    overwrite: bool = False
    resume: bool = False
    first_pass_only: bool = False


def record(
    source: FrameSource,
    config: PipelineConfig | Path | str | None,
    folder: Path | str,
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | Path | None = None,
    points: Any = None,
    start_frame: int | None = None,
    corrections: Iterable[Correction] = (),
    skip_damaged: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    listener: Listener = lambda frame: None,
) -> RunReader:
    """Track one object through ``source`` and write its run folder.

    With ``solver.final_refine`` there is a second pass, if the solver supports it and the source can be read again: the
    object is estimated in every frame again, with the final model.

    Args:
        source: The frames.
        config: The pipeline, or a YAML file of one; the default preset if None.
        folder: The run folder.
        box: The object in the first frame, ``(x, y, width, height)``.
        mask: The object in the first frame, as a mask or the image file of one. Without a box, a mask and points
            the tracker's own first mask is the prompt.
        points: The object in the first frame by ``(N, 3)`` points: x, y in pixels, and 1 on the object or 0 on the
            background. None of the three is needed if ``object.model`` says which object it is.
        start_frame: Index of the frame in which the object is given, instead of the first. The object is tracked from
            there to the end, and then backwards to the beginning with the same model. The source must be one that can
            be read again.
        corrections: Prompts in later frames: the mask tracker is re-anchored there, and the mask is trusted.
        skip_damaged: If the first frame cannot be decoded, apply the prompt to the first frame that can.
        overwrite: Replace a run that is in the folder.
        resume: Continue the run that is in the folder; see `RecordOptions`.
        listener: Is called with every frame, also with those that were finished before.

    Returns:
        The reader of the run folder.

    Raises:
        InputError: If the run in the folder has other settings or another source; the difference is named.
        Tracking3dError: The frames finished until then stay in the folder, as on Ctrl-C.
    """
    prompts = PromptSet.of_one(box, mask, points, start_frame)
    request = request_tracking(source, config, prompts, corrections, skip_damaged)
    options = RecordOptions(overwrite=overwrite, resume=resume)
    [reader] = record_tracking(request, folder, options, listener)
    return reader


def record_objects(
    source: FrameSource,
    config: PipelineConfig | Path | str | None,
    folder: Path | str,
    *,
    boxes: Sequence[Box] = (),
    masks: Sequence[NDArray[np.bool_] | Path] = (),
    points: Sequence[Any] = (),
    start_frame: int | None = None,
    corrections: Iterable[Correction] = (),
    skip_damaged: bool = False,
    overwrite: bool = False,
    resume: bool = False,
    listener: Listener = lambda frame: None,
) -> list[RunReader]:
    """Track several objects through ``source`` in one pass; each has a run folder of its own within ``folder``.

    An object that fails is ended and the others continue; the first failure is raised at the end.

    Args:
        source: The frames.
        config: The pipeline of every object.
        folder: Gets the run folders ``object_0``, ``object_1`` and so on, in the order of the objects.
        boxes: The objects in the first frame; see `record` for this and what follows.
        masks: More objects, after those of the boxes.
        points: More objects, after those of the masks.
        start_frame: The frame in which the objects are given.
        corrections: Prompts in later frames; `Correction.object` is the number of the object.
        skip_damaged: If the first frame cannot be decoded, apply the prompts to the first frame that can.
        overwrite: Replace runs that are in those folders.
        resume: Continue the runs that are in those folders; those that are finished stay as they are.
        listener: Is called with every frame of every object.

    Returns:
        The readers of the run folders, in the order of the objects.

    Raises:
        InputError: If a run in those folders has other settings or another source; the difference is named.
        Tracking3dError: The frames finished until then stay in the folders, as on Ctrl-C.
    """
    prompts = PromptSet(boxes, masks, points, start_frame, as_lists=True)
    request = request_tracking(source, config, prompts, corrections, skip_damaged)
    options = RecordOptions(overwrite=overwrite, resume=resume)
    return record_tracking(request, folder, options, listener)


def record_tracking(
    request: TrackRequest,
    folder: Path | str,
    options: RecordOptions,
    listener: Listener = lambda frame: None,
) -> list[RunReader]:
    """Track the objects of a request and write their run folders: what `record` and `record_objects` do.

    Args:
        request: What is to be tracked.
        folder: The run folder of the one object; if prompts were given as lists, the folder that gets one for each.
        options: How it is written.
        listener: Is called with every frame of every object.

    Returns:
        The readers of the run folders, in the order of the objects.

    Raises:
        InputError: If a run in those folders has other settings or another source; the difference is named.
        Tracking3dError: The frames finished until then stay in the folders, as on Ctrl-C.
    """
    folder, prompts = validate_folder(folder), request.prompts
    prompted = {index for one in request.corrections for index in one}
    prompted |= set() if prompts.start_frame is None else {prompts.start_frame}
    request = replace(request, source=without_repeats(request.source, prompted))
    folders = object_folders(folder, len(prompts)) if prompts.as_lists else [folder]
    check_output_folder(folder, options.overwrite)
    source, config, were_finished = _track_into(request, folders, options, listener)
    for into, was_finished in zip(folders, were_finished, strict=True):
        if options.first_pass_only:
            continue
        if was_finished:
            complete_run(into, config, source)
        elif "shape" not in RunReader(into).description:
            make_final_shape(into, config, source)
        apply_object_size(into, config.object)
    return [RunReader(into) for into in folders]


def _track_into(
    request: TrackRequest, folders: Sequence[Path], options: RecordOptions, listener: Listener
) -> tuple[FrameSource, PipelineConfig, list[bool]]:
    """Write run folders but for shapes, which get its memory: source, config, and which runs were finished before."""
    with (
        open_tracking(request, folders[0] if options.resume else None) as opened,
        ExitStack() as writers,
    ):
        recordings = [
            begin_recording(opened, number, into, options, writers) for number, into in enumerate(folders)
        ]
        if unfinished := [recording for recording in recordings if recording is not None]:
            with running(opened.source, unfinished, listener) as active:
                with closing(first_pass(opened.source, opened.frames, active)) as arriving:
                    for recording, frame, coming in arriving:
                        with active.guard(recording):
                            active.tell(recording.take(frame, coming))
                if not options.first_pass_only:
                    run_refinement(opened.source, active)
                for recording in active if options.first_pass_only else ():
                    with active.guard(recording):
                        recording.pause()
        return opened.source, opened.config, [recorded is None for recorded in recordings]


def begin_recording(
    opened: OpenTracking,
    number: int,
    folder: Path,
    options: RecordOptions,
    writers: ExitStack,
    temporary: bool = False,
) -> ObjectRecorder | None:
    """Begin or resume the recording of one object; None if its run is finished.

    Args:
        opened: The tracking.
        number: Which of its objects.
        folder: The object's run folder.
        options: How it is written.
        writers: Closes the run folder at the end.
        temporary: Whether the folder is removed in the end: no state is saved, and errors do not name the folder.

    Raises:
        OutputError: If the folder is in use, holds a run already, or cannot be written.
        InputError: If the run there cannot be resumed.
    """
    source, one = opened.source, opened.objects[number]
    session, runtime = one.session, opened.config.runtime
    given = prompt_record(
        opened.first, one.prompt, source.count, opened.start_frame, one.corrections.values()
    )
    header = _header(opened, one.session, options, given)
    earlier: Earlier = "none"
    damaged = False
    if options.resume:
        if not source.repeatable:
            raise InputError(
                f"{source.name} cannot be read again from its start, so that no run of it can be resumed."
            )
        take_over(folder)
        earlier = earlier_run(folder, header.config, options.selection, given)
    if earlier == "finished":
        if is_intact(folder):
            finish_state(folder)
            return None
        earlier, damaged = "outdated", True
    corrected: Path | None = None
    if earlier == "outdated":
        corrected = None if damaged else folder
        folder, earlier = stage_correction(folder, header.config, options.selection, given, writers)
        writers.callback(_reconstruct_shape_again, folder.parent, folder, opened)
        if earlier == "finished":
            return None
    checkpoint: Checkpoint | None = None
    kept: SavedState | None = None
    if earlier == "stopped":
        checkpoint = Checkpoint(folder, session.state_classes, runtime.device, runtime.rollback_points)
        kept = read_intact_state(folder, checkpoint)
    so_far = WrittenSoFar(kept.progress.lines, kept.progress.seconds, kept.skipped) if kept else None
    writer = writers.enter_context(
        RunWriter(folder, header, overwrite=options.overwrite or options.resume, resume=so_far)
    )
    keep_given_masks(folder, opened.first.index, one.prompt, one.corrections.values())
    if checkpoint is not None and kept is not None:
        checkpoint.remove_orphans()
        failures = {index: frame.failure for index, frame in kept.taken.items() if frame.failure}
        session.load_state_dict(opened.first, kept.session, failures)
        writer.use_camera(session.camera)
    elif not temporary and source.repeatable:
        checkpoint = Checkpoint(folder, session.state_classes, runtime.device, runtime.rollback_points)
    state = RunState(checkpoint, kept)
    return ObjectRecorder(one, writer, state, opened.start_frame is not None, temporary, corrected)


def _reconstruct_shape_again(corrected: Path, stage: Path, opened: OpenTracking) -> None:
    """Give a corrected run a shape from all frames if the run had one, before it takes the run's place."""
    from tracking3d.reconstruction.rebuild import keep_shape  # slow to import, and only needed at the end

    if not (is_finished(stage) and keeps_shape(corrected)):
        return
    kept = False
    with suppress(InputError, OSError):  # the run that is corrected may be damaged, or lack masks
        kept = keep_shape(corrected, stage)
    if not kept:
        make_final_shape(stage, opened.config, opened.source, always=True)


def _header(
    opened: OpenTracking, session: Session, options: RecordOptions, given: Mapping[str, Any]
) -> RunHeader:
    """What ``run.json`` says of an object's run from its start."""
    source, config = opened.source, opened.config
    height, width = opened.first.size
    return RunHeader(
        config=config.model_dump(mode="json"),
        camera=select_camera(config, width, height, source.intrinsics, source.intrinsics_origin),
        source=source.name,
        seed=config.runtime.seed,
        fps=source.fps,
        command=options.command,
        source_notes=source_notes(source),
        selection=options.selection,
        renderer=session.renderer,
        prompt=given,
        tracker_choice=opened.tracker_choice,
    )


_log = logging.getLogger(__name__)
_MADE_AGAIN = "%s: made again, since the finished run lacks it: %s."


def is_intact(folder: Path) -> bool:
    """Whether the estimates and the model of a finished run are whole; if not, a sentence says what is damaged.

    A texture that is missing is taken from ``mesh.glb``.

    Raises:
        OutputError: If the texture cannot be written.
    """
    if restore_texture(folder):
        _log.warning(_MADE_AGAIN, folder, layout.TEXTURE)
    damage = RunIntegrity(folder).of_finished(RunReader(folder))
    if damage:
        _log.warning(
            "%s: %s; what depends on it is computed again, and until then the run stays as it is.",
            folder,
            damage,
        )
    return not damage


def complete_run(folder: Path, config: PipelineConfig, source: FrameSource) -> None:
    """Make again what a finished run lacks: files of its mesh, its shape, the overlay, the contact sheet.

    Args:
        folder: The run folder; estimates and model in it are whole.
        config: Its configuration.
        source: Its video.

    Raises:
        InputError: If the run is damaged.
        OutputError: If something cannot be written.
    """
    missing = missing_files(folder, (*layout.MESH_FILES, *PICTURES))
    run = RunReader(folder)
    shapeless = "shape" not in run.description and is_reconstructed(run.frames, config, source)
    if missing or shapeless:
        names = [*missing, *(["the shape from all frames"] if shapeless else [])]
        _log.warning(_MADE_AGAIN, folder, ", ".join(names))
    if not set(layout.MESH_FILES).isdisjoint(missing):
        export_mesh(folder, load_model(folder), RunReader(folder).unit)
    if layout.OVERLAY in missing:
        redraw_overlay(RunReader(folder), read_again(source))
    elif layout.CONTACT_SHEET in missing:
        redraw_contact_sheet(RunReader(folder))
    if shapeless:
        make_final_shape(folder, config, source)
