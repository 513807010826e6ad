"""From a source to a run folder: every frame through the session, every answer kept the moment it exists."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, OutputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Box, Frame, SkippedFrame
from tracking3d.pipeline import Session, choose_camera
from tracking3d.prompts import make_prompt
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_writer import RunWriter
from tracking3d.video.source import FrameSource

Listener = Callable[[FrameRecord | SkippedFrame], None]
"""Is told of every frame as it is done, or skipped."""


def record(
    source: FrameSource,
    config: PipelineConfig,
    folder: Path,
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | Path | None = None,
    command: str | None = None,
    selection: str | None = None,
    overwrite: bool = False,
    listener: Listener = lambda frame: None,
) -> None:
    """Track the object through ``source`` and write the run folder.

    Args:
        source: The frames.
        config: The pipeline.
        folder: The run folder.
        box: The object in the first frame, ``(x, y, width, height)``.
        mask: The object in the first frame, as a mask or the image file of one. Without a box and a mask the
            tracker's own first mask is the prompt.
        command: The command line, for the record.
        selection: The ``START:STOP:STEP`` that the source was opened with, for the record.
        overwrite: Replace a run that is in the folder.
        listener: Is told of every frame.

    Raises:
        Tracking3dError: What was finished until then is kept in the folder, as it is on Ctrl-C.
    """
    frames = iter(source)
    skipped, first = _first_frame(frames, source.name)
    height, width = first.size
    camera = choose_camera(config.camera, width, height, source.intrinsics, source.intrinsics_origin)
    prompt = None if box is None and mask is None else make_prompt(first, box, mask)
    session = Session(config, prompt, source.intrinsics, source.intrinsics_origin)
    with RunWriter(
        folder,
        config=config.model_dump(mode="json"),
        camera=camera,
        source=source.name,
        seed=config.runtime.seed,
        renderer=session.renderer,
        fps=source.fps,
        command=command,
        selection=selection,
        overwrite=overwrite,
    ) as writer:
        answer: FrameRecord | None = None
        try:
            for item in skipped:
                writer.skip(item)
                listener(item)
            for frame in chain([first], frames):
                if isinstance(frame, SkippedFrame):
                    writer.skip(frame)
                    listener(frame)
                else:
                    answer = writer.write(session.step(frame), frame)
                    listener(answer)
        except BaseException as error:
            failed = isinstance(error, Exception)
            if answer is not None:
                error.add_note(f"What was finished until then is kept in {folder}.")
            with suppress(OutputError):  # the first error is the one to tell
                writer.finish(_model(session), "failed" if failed else "interrupted", str(error) or None)
            raise
        writer.finish(session.result(), "finished")


def _first_frame(frames: Iterator[Frame | SkippedFrame], name: str) -> tuple[list[SkippedFrame], Frame]:
    """The first frame that can be decoded, and those before it that cannot."""
    skipped: list[SkippedFrame] = []
    for frame in frames:
        if isinstance(frame, Frame):
            return skipped, frame
        skipped.append(frame)
    raise InputError(f"{name} has no frame that can be decoded.")


def _model(session: Session) -> ObjectModel | None:
    """The object as far as it is known; None where the session stopped in a state that gives none."""
    try:
        return session.result()
    except Exception:
        return None
