"""From a source to a run folder: every frame through the session, every answer kept the moment it exists."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.checkpoint.folder import Checkpoint, finish_state
from tracking3d.checkpoint.resuming import earlier_run, prompt_record
from tracking3d.checkpoint.staging import stage_correction, take_over
from tracking3d.config.models import PipelineConfig, PluginChoice
from tracking3d.errors import InputError
from tracking3d.frames import Box, Frame, Prompt, SkippedFrame
from tracking3d.pipeline.components import build_encoder, check_backward_tracking
from tracking3d.pipeline.known_object import camera_of
from tracking3d.pipeline.passes import Listener, run_passes, time_frames
from tracking3d.pipeline.recorder import ObjectRecorder
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.tracker_selection import AUTO, choose_tracker
from tracking3d.pipeline.validation import (
    check_known,
    check_source,
    needs_prompt,
    validate_config,
    validate_folder,
)
from tracking3d.prompts.corrections import Correction, check_corrections_fit, validate_corrections
from tracking3d.prompts.prompt import (
    check_prompt,
    check_prompts,
    damaged_start_error,
    make_prompt,
    make_prompts,
)
from tracking3d.reconstruction.final_shape import make_final_shape
from tracking3d.results.given_masks import keep_given_masks
from tracking3d.results.layout import RUN, object_folders
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import RunWriter, WrittenSoFar
from tracking3d.video.both_ways import both_ways, check_start_frame
from tracking3d.video.source import FrameSource, notes_of

_log = logging.getLogger(__name__)

__all__ = ["Listener", "record", "record_objects"]


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
    command: str | None = None,
    selection: str | None = None,
    overwrite: bool = False,
    skip_damaged: bool = False,
    resume: bool = False,
    first_pass_only: bool = False,
    listener: Listener = lambda frame: None,
) -> RunReader:
    """Track the object through ``source`` and write the run folder.

    With ``solver.final_refine`` the frames are gone through a second time, where the solver can use that and the
    source can be read again: every frame is answered anew against the final object.

    Args:
        source: The frames.
        config: The pipeline, or a YAML file of one; the default preset if None.
        folder: The run folder.
        box: The object in the first frame, ``(x, y, width, height)``.
        mask: The object in the first frame, as a mask or the image file of one. Without a box, a mask and points
            the tracker's own first mask is the prompt.
        points: The object in the first frame by ``(N, 3)`` points: x, y in pixels, and 1 on it or 0 beside it. None of
            the three is needed where ``object.model`` says which object it is.
        start_frame: Index of the frame in which the object is given, instead of the first: it is tracked from there to
            the end, and then backwards to the beginning, with what was learnt. Only of a source that can be read
            again.
        corrections: What the object is in later frames: there the mask tracker is set on it, and the mask is trusted.
        command: The command line, for the record.
        selection: The ``START:STOP:STEP`` that the source was opened with, for the record.
        overwrite: Replace a run that is in the folder.
        skip_damaged: Where the first frame cannot be read, take the box or mask for the first one that can.
        resume: Go on with the run that is in the folder, from the last frame that it finished; begin one where there
            is none. With a finished run nothing is done. Where a frame that is answered is corrected, what depends on
            it is computed again, from the last state of before it that was kept, in a copy within the folder; until
            that is finished the run stays as it is.
        first_pass_only: Stop when every frame has its causal answer; ``resume`` goes on from there.
        listener: Is told of every frame, those finished before included.

    Returns:
        The reader of the run folder.

    Raises:
        InputError: If the run in the folder is of other settings or another source; the difference is named.
        Tracking3dError: What was finished until then is kept in the folder, as it is on Ctrl-C.
    """
    check_source(source)
    config, folder = validate_config(config), validate_folder(folder)
    check_prompt(box, mask, needed=needs_prompt(config), points=points)
    [told] = validate_corrections(corrections)
    begin = partial(
        begin_recording, source, command=command, selection=selection, overwrite=overwrite, resume=resume,
        start_frame=start_frame,
    )  # fmt: skip
    untold = box is None and mask is None and points is None
    with open_frames_in_order(source, config, start_frame) as frames, ExitStack() as writers:
        skipped, first = first_frame(frames, source.name, skip_damaged or untold)
        prompt = None if untold else make_prompt(first, box, mask, points=points)
        config, choice = select_tracker(config, source, first, prompt, folder, resume)
        session = Session(config, prompt, source.intrinsics, source.intrinsics_origin)
        recording = begin(
            session, prompt, choice=choice, first=first, folder=folder, writers=writers, corrections=told
        )
        if recording is not None:
            run_passes(source, chain(skipped, [first], frames), [recording], listener, first_pass_only)
    if recording is not None and not first_pass_only:
        make_final_shape(folder, config, source)
    return RunReader(folder)


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
    command: str | None = None,
    selection: str | None = None,
    overwrite: bool = False,
    skip_damaged: bool = False,
    resume: bool = False,
    listener: Listener = lambda frame: None,
) -> list[RunReader]:
    """Track several objects through ``source`` in one pass; each has a run folder of its own within ``folder``.

    An object that fails is ended and the others go on; the first failure is raised at the end.

    Args:
        source: The frames.
        config: The pipeline of every object.
        folder: Gets the run folders ``object_0``, ``object_1`` and so on, in the order of the objects.
        boxes: The objects in the first frame; see `record` for this and what follows.
        masks: More objects, after those of the boxes.
        points: More objects, after those of the masks.
        start_frame: The frame in which the objects are given.
        corrections: What an object is in later frames; `Correction.object` says which, in the order of the objects.
        command: The command line.
        selection: The ``START:STOP:STEP`` that the source was opened with.
        overwrite: Replace runs that are in those folders.
        skip_damaged: Where the first frame cannot be read, take the boxes and masks for the first one that can.
        resume: Go on with the runs that are in those folders; those that are finished stay as they are.
        listener: Is told of every frame of every object.

    Returns:
        The readers of the run folders, in the order of the objects.

    Raises:
        InputError: If a run in those folders is of other settings or another source; the difference is named.
        Tracking3dError: What was finished until then is kept in the folders, as it is on Ctrl-C.
    """
    check_source(source)
    config, folder = validate_config(config), validate_folder(folder)
    check_prompts(boxes, masks, points)
    check_known(config, len(boxes) + len(masks) + len(points))
    told = validate_corrections(corrections, len(boxes) + len(masks) + len(points))
    begin = partial(
        begin_recording, source, command=command, selection=selection, overwrite=overwrite, resume=resume,
        start_frame=start_frame,
    )  # fmt: skip
    with open_frames_in_order(source, config, start_frame) as frames, ExitStack() as writers:
        skipped, first = first_frame(frames, source.name, skip_damaged)
        prompts = make_prompts(first, boxes, masks, config.tracker.name, points)
        folders = object_folders(folder, len(prompts))
        config, choice = select_tracker(config, source, first, prompts[0], folders[0], resume)
        encoder = build_encoder(config)
        sessions = [
            Session(config, prompt, source.intrinsics, source.intrinsics_origin, encoder)
            for prompt in prompts
        ]
        recordings = [
            begin(
                session, prompt, choice=choice, first=first, folder=into, writers=writers, corrections=theirs
            )
            for session, prompt, into, theirs in zip(sessions, prompts, folders, told, strict=True)
        ]
        if unfinished := [recording for recording in recordings if recording is not None]:
            run_passes(source, chain(skipped, [first], frames), unfinished, listener)
    for one, begun_now in zip(folders, recordings, strict=True):
        if begun_now is not None:
            make_final_shape(one, config, source)
    return [RunReader(one) for one in folders]


@contextmanager
def open_frames_in_order(
    source: FrameSource, config: PipelineConfig, start_frame: int | None = None
) -> Iterator[Iterator[Frame | SkippedFrame]]:
    """The frames of a source, which is let go at the end, however that comes.

    Args:
        source: The source.
        config: The pipeline.
        start_frame: The frame to start from and to go both ways; None gives the frames in order of time.

    Raises:
        InputError: If the source or the solver cannot go both ways.
    """
    check_order(source, config, start_frame)
    once = partial(time_frames, source)
    frames = once() if start_frame is None else both_ways(once, start_frame, source.name)
    try:
        yield frames
    finally:
        frames.close()


def check_order(source: FrameSource, config: PipelineConfig, start_frame: int | None) -> None:
    """Make sure that source and solver can go both ways, where that is asked for; see `open_frames_in_order`.

    Raises:
        InputError: If not.
    """
    if start_frame is not None:
        check_start_frame(start_frame, source.repeatable, source.name)
        check_backward_tracking(config)


def begin_recording(
    source: FrameSource,
    session: Session,
    prompt: Prompt | None,
    *,
    choice: str | None,
    first: Frame,
    folder: Path,
    command: str | None,
    selection: str | None,
    overwrite: bool,
    resume: bool,
    writers: ExitStack,
    start_frame: int | None = None,
    corrections: Mapping[int, Correction] | None = None,
    resumable: bool = True,
) -> ObjectRecorder | None:
    """One object's recording, begun or resumed; None where its run is finished. See `record` for the arguments.

    Where it is not to be ``resumable``, no state is kept on the way.

    Raises:
        OutputError: If the folder is in use, holds a run already, or cannot be written.
        InputError: If the run there cannot be resumed.
    """
    corrections = corrections or {}
    check_corrections_fit(
        corrections.values(), first, session.config.tracker.name, getattr(source, "selection", None)
    )
    given = prompt_record(first, prompt, source.count, start_frame, corrections.values())
    config = session.config.model_dump(mode="json")
    if resume and not source.repeatable:
        raise InputError(
            f"{source.name} cannot be read again from its start, so that no run of it can be resumed."
        )
    if resume:
        take_over(folder)
    earlier = earlier_run(folder, config, selection, given) if resume else "none"
    if earlier == "finished":
        finish_state(folder)
        return None
    if earlier == "outdated":
        folder, earlier = stage_correction(folder, config, selection, given, writers)
    runtime = session.config.runtime
    keeps = runtime.device, runtime.rollback_points
    checkpoint = kept = None
    if earlier == "stopped":
        checkpoint = Checkpoint(folder, session.state_classes, *keeps)
        kept = checkpoint.read()
    height, width = first.size
    writer = RunWriter(
        folder,
        config=config,
        camera=camera_of(session.config, width, height, source.intrinsics, source.intrinsics_origin),
        source=source.name,
        seed=session.config.runtime.seed,
        renderer=session.renderer,
        fps=source.fps,
        source_notes=notes_of(source),
        command=command,
        selection=selection,
        given=given,
        tracker_choice=choice,
        overwrite=overwrite or resume,
        resume=WrittenSoFar(kept.progress.lines, kept.progress.seconds, kept.skipped) if kept else None,
    )
    writers.enter_context(writer)
    keep_given_masks(folder, first.index, prompt, corrections.values())
    if checkpoint is not None and kept is not None:
        checkpoint.clear_strangers()
        failures = {index: frame.failure for index, frame in kept.taken.items() if frame.failure}
        session.resume(first, kept.session, failures)
        writer.use_camera(session.camera)
    elif resumable and source.repeatable:
        checkpoint = Checkpoint(folder, session.state_classes, *keeps)
    return ObjectRecorder(session, writer, checkpoint, kept, corrections, redraw=start_frame is not None)


def select_tracker(
    config: PipelineConfig,
    source: FrameSource,
    first: Frame,
    prompt: Prompt | None,
    folder: Path,
    resume: bool,
) -> tuple[PipelineConfig, str | None]:
    """The configuration with a tracker in place of ``auto``, and why it is that one; None where it was named.

    A run that goes on does so with the tracker that it was begun with.
    """
    if config.tracker.name != AUTO:
        return config, None
    if resume and (folder / RUN).is_file():
        before = RunReader(folder)
        if why := before.description.get("tracker_choice"):
            tracker = PluginChoice.model_validate(before.config["tracker"])
            return config.model_copy(update={"tracker": tracker}), str(why)
    config, why = choose_tracker(config, source.count, not source.repeatable, first, prompt)
    _log.info("Mask tracker: %s.", why)
    return config, why


def first_frame(
    frames: Iterator[Frame | SkippedFrame], name: str, skip_damaged: bool
) -> tuple[list[SkippedFrame], Frame]:
    """The first frame that can be decoded, and those before it that cannot.

    Raises:
        InputError: If there is none; or there are frames before it, and they must not be skipped.
    """
    skipped: list[SkippedFrame] = []
    for frame in frames:
        if isinstance(frame, Frame):
            return skipped, frame
        if not skip_damaged:
            raise damaged_start_error(frame)
        skipped.append(frame)
    raise InputError(f"{name} has no frame that can be decoded.")
