"""Objects on their way from the frames to their run folders: answered, kept, and looked at once more at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tracking3d.errors import OutputError, PluginError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Frame, MaskEstimate, SkippedFrame
from tracking3d.results.records import FrameRecord
from tracking3d.results.refinement_writer import RefinementWriter
from tracking3d.results.run_writer import RunWriter
from tracking3d.session import Session
from tracking3d.video.source import FrameSource

Listener = Callable[[FrameRecord | SkippedFrame], None]
"""Is told of every frame as it is done, or skipped; where there is a final refinement, once more of each."""


class ObjectRecording:
    """One object on its way from the frames to its run folder.

    Args:
        session: Answers for the frames.
        writer: Keeps the answers.
    """

    def __init__(self, session: Session, writer: RunWriter) -> None:
        self._session, self._writer = session, writer
        self._answered = False
        self._initial: dict[int, tuple[float, str]] = {}
        self._causal_model: ObjectModel | None = None
        self._refinement: RefinementWriter | None = None

    def take(self, frame: Frame | SkippedFrame) -> FrameRecord | SkippedFrame:
        """Answer for the next frame and keep the answer."""
        if isinstance(frame, SkippedFrame):
            self._writer.skip(frame)
            return frame
        answer = self._writer.write(self._session.step(frame), frame)
        self._answered = True
        if self._session.config.solver.final_refine:
            self._initial[frame.index] = self._session.initial_mask.score, self._session.initial_mask.reason
        return answer

    @property
    def refines(self) -> bool:
        """Whether the frames are to come once more."""
        return self._refinement is not None

    def begin_refinement(self, source: FrameSource) -> None:
        """All frames were taken: solve everything once more, or record why not though it was asked for."""
        solver = self._session.config.solver
        if not solver.final_refine:
            return
        if not self._session.can_refine or not source.repeatable:
            self._writer.leave_out_refinement(
                f"{source.name} cannot be read a second time"
                if self._session.can_refine
                else f"the solver {solver.name} gives causal answers only"
            )
            return
        self._causal_model = self._session.result()
        self._refinement = self._writer.begin_refinement(self._causal_model)
        self._session.refine()
        self._refinement.together = self._session.refining
        self._writer.refine_camera(self._session.camera)

    def take_again(self, frame: Frame) -> FrameRecord | None:
        """Answer for a frame once more; None where it has no causal answer or there is no refinement."""
        refinement = self._refinement
        if refinement is None or frame.index not in refinement.causal:
            return None
        mask = refinement.initial_mask(frame.index)
        score, reason = self._initial.get(frame.index, (1.0, ""))
        initial = MaskEstimate(None if mask is None else mask.astype(np.float32), score, reason)
        try:
            estimate = self._session.revisit(frame, initial, refinement.causal[frame.index].T_cam_obj)
        except PluginError:
            if self._session.config.runtime.on_plugin_failure == "stop":
                raise
            return refinement.write(None, frame)
        return refinement.write(estimate, frame)

    def finish(self) -> None:
        """Write what is made at the end."""
        model = self._session.result()
        if self._refinement is not None:
            self._writer.end_refinement()
            self._causal_model = None
        self._writer.finish(model, "finished")

    def give_up(self, error: BaseException) -> None:
        """Keep what is finished when ``error`` ends the run, and let ``error`` say so."""
        failed = isinstance(error, Exception)
        folder = self._writer.folder
        if self._causal_model is not None:
            error.add_note(
                f"The final refinement was not finished; the causal answers are whole in {folder}."
            )
        elif self._answered:
            error.add_note(f"What was finished until then is kept in {folder}.")
        model = self._causal_model or _model(self._session)
        with suppress(OutputError):  # the first error is the one to tell
            self._writer.finish(model, "failed" if failed else "interrupted", str(error) or None)


def go_through(
    source: FrameSource,
    frames: Iterable[Frame | SkippedFrame],
    recordings: list[ObjectRecording],
    listener: Listener,
) -> None:
    """Take every recording through the frames, and through them again where it refines.

    A recording that fails is ended; the others go on.

    Args:
        source: Where the frames come from.
        frames: Its frames, begun already.
        recordings: One an object.
        listener: Is told of every frame of every object.

    Raises:
        Tracking3dError: The first failure, at the end or as soon as no recording is left.
    """
    going_on, errors = list(recordings), list[Exception]()
    share = 1 / len(recordings)

    def each(action: Callable[[ObjectRecording], FrameRecord | SkippedFrame | None]) -> None:
        for recording in tuple(going_on):
            try:
                if told := action(recording):
                    listener(told)
            except Exception as error:
                going_on.remove(recording)
                recording.give_up(error)
                errors.append(error)
        if not going_on:
            raise errors[0]

    try:
        for frame in frames:
            each(partial(ObjectRecording.take, frame=_shared(frame, share)))
        each(partial(ObjectRecording.begin_refinement, source=source))
        for frame in timed(source) if any(recording.refines for recording in going_on) else ():
            if isinstance(frame, Frame):
                each(partial(ObjectRecording.take_again, frame=_shared(frame, share)))
        each(ObjectRecording.finish)
    except BaseException as error:
        for recording in going_on:
            recording.give_up(error)
        raise
    if errors:
        raise errors[0]


def timed(source: FrameSource) -> Generator[Frame | SkippedFrame]:
    """The frames of a source with the time that reading them took; of a live one, which is waited for, without."""
    frames, started = iter(source), time.perf_counter()
    try:
        for frame in frames:
            if isinstance(frame, Frame) and source.repeatable:
                yield replace(frame, decoding=time.perf_counter() - started)
            else:
                yield frame
            started = time.perf_counter()
    finally:
        if isinstance(frames, Generator):
            frames.close()


def _shared(frame: Frame | SkippedFrame, share: float) -> Any:
    return replace(frame, decoding=share * frame.decoding) if isinstance(frame, Frame) else frame


def _model(session: Session) -> ObjectModel | None:
    """The object as far as it is known; None where the session stopped in a state that gives none."""
    try:
        return session.result()
    except Exception:
        return None
