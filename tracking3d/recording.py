"""From a source to a run folder: every frame through the session, every answer kept the moment it exists."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.arguments import check_source, checked_config, checked_folder
from tracking3d.config.camera import choose_camera
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.frames import Box, Frame, SkippedFrame
from tracking3d.object_recording import Listener, ObjectRecording, go_through, timed
from tracking3d.prompts import check_prompt, check_prompts, damaged_start, make_prompt, make_prompts
from tracking3d.results.layout import object_folders
from tracking3d.results.run_writer import RunWriter
from tracking3d.session import Session, build_encoder
from tracking3d.video.source import FrameSource

__all__ = ["Listener", "record", "record_objects"]


def record(
    source: FrameSource,
    config: PipelineConfig | Path | str | None,
    folder: Path | str,
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | Path | None = None,
    command: str | None = None,
    selection: str | None = None,
    overwrite: bool = False,
    skip_damaged: bool = False,
    listener: Listener = lambda frame: None,
) -> None:
    """Track the object through ``source`` and write the run folder.

    With ``solver.final_refine`` the frames are gone through a second time, where the solver can use that and the
    source can be read again: every frame is answered anew against the final object.

    Args:
        source: The frames.
        config: The pipeline, or a YAML file of one; the default preset if None.
        folder: The run folder.
        box: The object in the first frame, ``(x, y, width, height)``.
        mask: The object in the first frame, as a mask or the image file of one. Without a box and a mask the
            tracker's own first mask is the prompt.
        command: The command line, for the record.
        selection: The ``START:STOP:STEP`` that the source was opened with, for the record.
        overwrite: Replace a run that is in the folder.
        skip_damaged: Where the first frame cannot be read, take the box or mask for the first one that can.
        listener: Is told of every frame.

    Raises:
        Tracking3dError: What was finished until then is kept in the folder, as it is on Ctrl-C.
    """
    check_source(source)
    config, folder = checked_config(config), checked_folder(folder)
    check_prompt(box, mask, needed=config.tracker.name != "precomputed")
    begin = partial(run_writer, source, command=command, selection=selection, overwrite=overwrite)
    with opened(source) as frames:
        skipped, first = first_frame(frames, source.name, skip_damaged or (box is None and mask is None))
        prompt = None if box is None and mask is None else make_prompt(first, box, mask)
        session = Session(config, prompt, source.intrinsics, source.intrinsics_origin)
        with begin(session, first=first, folder=folder) as writer:
            go_through(source, chain(skipped, [first], frames), [ObjectRecording(session, writer)], listener)


def record_objects(
    source: FrameSource,
    config: PipelineConfig | Path | str | None,
    folder: Path | str,
    *,
    boxes: Sequence[Box] = (),
    masks: Sequence[NDArray[np.bool_] | Path] = (),
    command: str | None = None,
    selection: str | None = None,
    overwrite: bool = False,
    skip_damaged: bool = False,
    listener: Listener = lambda frame: None,
) -> None:
    """Track several objects through ``source`` in one pass; each has a run folder of its own within ``folder``.

    An object that fails is ended and the others go on; the first failure is raised at the end.

    Args:
        source: The frames.
        config: The pipeline of every object.
        folder: Gets the run folders ``object_0``, ``object_1`` and so on, in the order of the objects.
        boxes: The objects in the first frame; see `record` for this and what follows.
        masks: More objects, after those of the boxes.
        command: The command line.
        selection: The ``START:STOP:STEP`` that the source was opened with.
        overwrite: Replace runs that are in those folders.
        skip_damaged: Where the first frame cannot be read, take the boxes and masks for the first one that can.
        listener: Is told of every frame of every object.

    Raises:
        Tracking3dError: What was finished until then is kept in the folders, as it is on Ctrl-C.
    """
    check_source(source)
    config, folder = checked_config(config), checked_folder(folder)
    check_prompts(boxes, masks)
    begin = partial(run_writer, source, command=command, selection=selection, overwrite=overwrite)
    with opened(source) as frames, ExitStack() as writers:
        skipped, first = first_frame(frames, source.name, skip_damaged)
        prompts = make_prompts(first, boxes, masks, config.tracker.name)
        folders = object_folders(folder, len(prompts))
        encoder = build_encoder(config)
        sessions = [
            Session(config, prompt, source.intrinsics, source.intrinsics_origin, encoder)
            for prompt in prompts
        ]
        recordings = [
            ObjectRecording(session, writers.enter_context(begin(session, first=first, folder=into)))
            for session, into in zip(sessions, folders, strict=True)
        ]
        go_through(source, chain(skipped, [first], frames), recordings, listener)


@contextmanager
def opened(source: FrameSource) -> Iterator[Iterator[Frame | SkippedFrame]]:
    """The frames of a source, which is let go at the end, however that comes."""
    frames = timed(source)
    try:
        yield frames
    finally:
        frames.close()


def run_writer(
    source: FrameSource,
    session: Session,
    *,
    first: Frame,
    folder: Path,
    command: str | None,
    selection: str | None,
    overwrite: bool,
) -> RunWriter:
    """The writer of one object's run folder; see `record` for the arguments.

    Raises:
        OutputError: If the folder is in use, holds a run already, or cannot be written.
    """
    config, (height, width) = session.config, first.size
    return RunWriter(
        folder,
        config=config.model_dump(mode="json"),
        camera=choose_camera(config.camera, width, height, source.intrinsics, source.intrinsics_origin),
        source=source.name,
        seed=config.runtime.seed,
        renderer=session.renderer,
        fps=source.fps,
        command=command,
        selection=selection,
        overwrite=overwrite,
    )


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
            raise damaged_start(frame)
        skipped.append(frame)
    raise InputError(f"{name} has no frame that can be decoded.")
