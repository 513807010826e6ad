"""Objects on their way from the frames to their run folders: answered, kept, and looked at once more at the end."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.checkpoint.progress import Kept, Progress, TakenFrame, checksum
from tracking3d.checkpoint.trees import UnkeptError
from tracking3d.corrections import Correction, prompts_in
from tracking3d.errors import InputError, OutputError, PluginError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame, MaskEstimate, SkippedFrame
from tracking3d.reconstruction import BELIEVED, TextureView, kept_views, texture_view, textured
from tracking3d.reconstruction.second_look import SecondLook
from tracking3d.reconstruction.second_masks import Decision, Masked, SecondMasks
from tracking3d.results.mesh_export import load_model
from tracking3d.results.records import FrameRecord
from tracking3d.results.refinement_writer import RefinementWriter
from tracking3d.results.run_writer import RunWriter
from tracking3d.session import Session
from tracking3d.stages import measured
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)


class ObjectRecording:
    """One object on its way from the frames to its run folder.

    Args:
        session: Answers for the frames.
        writer: Keeps the answers.
        checkpoint: Keeps the state after each; None where that is of no use, since the source cannot be read again.
        kept: The state of a stopped run that this one goes on with, which ``session`` was given.
        corrections: What the user has said of the object in later frames, by their index.
        redraw: Whether frames come in another order than that of time, and are drawn once more in that order.

    Attributes:
        latest: The answer for the frame that was taken last.
    """

    def __init__(
        self,
        session: Session,
        writer: RunWriter,
        checkpoint: Checkpoint | None = None,
        kept: Kept | None = None,
        corrections: Mapping[int, Correction] | None = None,
        redraw: bool = False,
    ) -> None:
        self._session, self._writer, self._checkpoint = session, writer, checkpoint
        self._corrections, self._unmet = corrections or {}, set(corrections or {})
        self._redraw = redraw
        self._kept = kept
        self.latest: FrameEstimate | None = None
        self._progress = kept.progress if kept else Progress()
        self._until = self._progress  # what was done before
        self._past = {*kept.taken, *(one.index for one in kept.skipped)} if kept else set()
        self._answered = kept is not None
        self._said = False
        self._initial: dict[int, tuple[float, str]] = {}
        if kept and session.config.solver.final_refine:
            self._initial = {one.index: (one.score, one.reason) for one in kept.taken.values()}
        self._causal_model: ObjectModel | None = None
        self._refinement: RefinementWriter | None = None
        self._look: SecondLook | None = None
        self._faces: NDArray[np.int64] = np.zeros((0, 3), np.int64)
        self._masks: SecondMasks | None = None
        self._views: tuple[TextureView, ...] = ()

    def take(self, frame: Frame | SkippedFrame) -> FrameRecord | SkippedFrame | None:
        """Answer for the next frame and keep the answer; what was answered before the run was stopped stands."""
        if isinstance(frame, Frame):
            self._unmet.discard(frame.index)
        if self._kept and frame.index in self._past:
            return self._take_kept(self._kept, frame)
        if isinstance(frame, SkippedFrame):
            self._writer.skip(frame)
            if self._checkpoint:
                self._checkpoint.note(frame)
            return frame
        estimate = self._session.step(frame, *prompts_in(frame, self._corrections))
        answer = self._writer.write(estimate, frame)
        self._answered, self.latest = True, estimate
        initial = self._session.initial_mask
        if self._session.config.solver.final_refine:
            self._initial[frame.index] = initial.score, initial.reason
        if self._checkpoint:
            if self._session.corrected:
                self._checkpoint.keep_correction(frame.index, estimate.mask)
            taken = TakenFrame(
                frame.index,
                checksum(frame.image),
                initial.score,
                initial.reason,
                self._session.corrected,
                self._session.failure_at(frame.index),
            )
            self._progress = replace(self._progress, last=frame.index, lines=self._writer.lines)
            self._keep(taken, [one.index for one in estimate.revised])
        return answer

    @property
    def takes(self) -> bool:
        """Whether the frames are to come for the first time, or for the mask tracker to see them again."""
        return not self._until.refining

    @property
    def looks_again(self) -> bool:
        """Whether the frames are to come once more, in order of time."""
        return self._refinement is not None or self._redraw

    def begin_refinement(self, source: FrameSource) -> None:
        """All frames were taken: solve everything once more, or record why not though it was asked for."""
        for index in sorted(self._unmet):
            _log.warning(
                "Frame %d, which was to be corrected, is not among the frames that could be read.", index
            )
        self._begin_refinement(source)
        if self._refinement is not None:
            answered = sorted(self._refinement.causal)
            most = self._session.config.object.landmark_views
            model = self._session.result()
            self._look = SecondLook(model, self._session.camera, answered, most)
            self._faces = model.faces
        elif self._redraw:
            self._writer.begin_drawing_anew()

    def _begin_refinement(self, source: FrameSource) -> None:
        if self._until.refining:
            self._refinement = self._writer.begin_refinement(
                None, self._until.refined_lines, self._until.refinement_seconds
            )
            self._causal_model = load_model(self._writer.folder)
            self._refinement.together = self._session.refining
            self._writer.refine_camera(self._session.camera)
            return
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
        self._progress = replace(self._progress, refining=True)
        self._keep()

    def take_again(self, frame: Frame) -> FrameRecord | None:
        """Answer for a frame once more; None where it has no causal answer or there is no refinement."""
        refinement = self._refinement
        if refinement is None:
            self._writer.draw_again(frame)
            return None
        if frame.index not in refinement.causal:
            return None
        if self._kept:
            self._check(self._kept, frame)
            if frame.index <= self._until.last_refined:
                return self._seen_again(refinement, refinement.answer(frame.index), frame)
        mask = refinement.initial_mask(frame.index)
        score, reason = self._initial.get(frame.index, (1.0, ""))
        initial = MaskEstimate(None if mask is None else mask.astype(np.float32), score, reason)
        try:
            estimate = self._session.revisit(frame, initial, refinement.causal[frame.index].T_cam_obj)
        except PluginError:
            if self._session.config.runtime.on_plugin_failure == "stop":
                raise
            answer = refinement.write(None, frame)
        else:
            answer = refinement.write(estimate, frame)
        self._progress = replace(self._progress, last_refined=frame.index, refined_lines=refinement.lines)
        self._keep()
        return self._seen_again(refinement, answer, frame)

    def _seen_again(self, refinement: RefinementWriter, answer: FrameRecord, frame: Frame) -> FrameRecord:
        """Keep what poses, surface and texture of the end can be taken from; the answer as it is."""
        most, mask = self._session.config.object.texture_views, refinement.mask(answer)
        if self._look and answer.refined:
            self._look.see(answer, frame.image, mask)
        if most and answer.status is Status.TRACKED and answer.confidence >= BELIEVED:
            camera = answer.through(self._session.camera)
            image, seen = camera.undistorted(frame.image), camera.mask_to_pinhole(mask)
            view = texture_view(frame.index, image, seen, camera, answer.T_cam_obj)
            self._views = self._views if view is None else kept_views(self._views, view, most)
        return answer

    @property
    def draws(self) -> bool:
        """Whether the frames are to come a last time, to be drawn as they are answered in the end."""
        return self._refinement is not None

    def settle(self) -> None:
        """All frames were looked at again: put right together what they say."""
        if self._refinement is None or self._look is None:
            return
        with measured("map") as watch:
            self._look.settle()
        self._refinement.together += watch.times
        self._writer.refine_camera(self._look.camera)
        if self._session.config.object.evidence:
            answers = [self._refinement.answer(index) for index in self._refinement.causal]
            self._masks = SecondMasks(self._look.camera, self._look.vertices, self._faces, answers)

    def put_right(self, frame: Frame) -> None:
        """Give the final answer for a frame the pose that all frames together say."""
        refinement = self._refinement
        if refinement is None or self._look is None or frame.index not in refinement.causal:
            return
        answer = refinement.answer(frame.index)
        if answer.refined:
            T_cam_obj = self._look.pose(answer, frame.image, refinement.mask(answer))
            refinement.put_right(frame.index, T_cam_obj)
        if self._masks:
            self._masks.see(self._masked(refinement, frame))

    def draw(self, frame: Frame) -> None:
        """Draw the final answer for a frame, its mask weighed once more; some frames late, with those around them."""
        refinement = self._refinement
        if refinement is None or frame.index not in refinement.causal:
            return
        if self._masks is None:
            refinement.draw(frame)
        else:
            self._draw(refinement, self._masks.decide(self._masked(refinement, frame)))

    def _masked(self, refinement: RefinementWriter, frame: Frame) -> Masked:
        answer = refinement.answer(frame.index)
        initial, fixed = refinement.initial_mask(frame.index), frame.index in self._corrections
        return Masked(frame, answer, initial, refinement.mask(answer), fixed)

    def _draw(self, refinement: RefinementWriter, decisions: Iterator[Decision]) -> None:
        with measured("map") as watch:
            for frame, decided in decisions:
                if decided is not None:
                    refinement.put_mask(frame.index, decided.mask, decided.probability)
                refinement.draw(frame)
        refinement.together += watch.times

    def finish(self) -> None:
        """Write what is made at the end."""
        if self._refinement is not None and self._masks is not None:
            self._draw(self._refinement, self._masks.rest())
        model, views = self._session.result(), self._views
        if self._refinement is not None and self._look is not None:
            answers = [self._refinement.answer(view.index) for view in views]
            model = self._look.moved(model)
            views = tuple(map(self._look.seen_by, views, answers))
        model = textured(model, views, self._session.config.object.largest_texture)
        if self._refinement is not None:
            self._writer.end_refinement()
            self._causal_model = None
        self._writer.finish(model, "finished")
        if self._checkpoint:
            self._checkpoint.finish()

    def pause(self) -> None:
        """Stop here; the folder is that of a stopped run, which can go on."""
        self._writer.finish(_model(self._session), "interrupted")

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

    def _take_kept(self, kept: Kept, frame: Frame | SkippedFrame) -> FrameRecord | SkippedFrame | None:
        """Draw a frame that is answered, and show it to a mask tracker that knows no other way to go on."""
        if isinstance(frame, SkippedFrame) and frame.index not in kept.taken:
            return frame
        if frame.index not in kept.taken or self._until.refining:
            return None
        self._check(kept, frame)
        assert isinstance(frame, Frame)
        if self._session.replays:
            taken, first = kept.taken[frame.index], frame.index == next(iter(kept.taken))
            correction = None
            if taken.corrected and self._checkpoint:
                correction = self._checkpoint.correction(frame.index)
            answer = self._session.replay(frame, first, correction, *prompts_in(frame, self._corrections))
            if (
                not self._said
                and not taken.failure
                and answer
                and not self._writer.is_initial_mask(frame, answer)
            ):
                self._said = True
                _log.warning(
                    "The mask tracker gives another mask of %s than before the run was stopped; what follows may "
                    "differ from a run that was not.",
                    frame.name or f"frame {frame.index}",
                )
        return self._writer.draw_again(frame)

    def _check(self, kept: Kept, frame: Frame | SkippedFrame) -> None:
        """Make sure that a frame is the one that was answered before the run was stopped."""
        taken = kept.taken.get(frame.index)
        if isinstance(frame, SkippedFrame):
            raise InputError(
                f"Frame {frame.index} was read before the run was stopped, but cannot be now ({frame.reason})."
            )
        if taken is not None and taken.picture != checksum(frame.image):
            raise InputError(
                f"{frame.name or f'frame {frame.index}'} shows another picture than when it was answered; a run goes "
                "on with the same source only."
            )

    def _keep(self, taken: TakenFrame | None = None, revised: Iterable[int] = ()) -> None:
        """Keep the state as it is now."""
        if self._checkpoint is None:
            return
        self._progress = replace(
            self._progress,
            seconds=self._writer.seconds,
            refinement_seconds=self._refinement.seconds if self._refinement else 0.0,
        )
        try:
            self._checkpoint.save(self._progress, self._session.kept(), taken, revised)
        except UnkeptError as error:
            _log.warning("This run cannot be resumed when it is stopped: %s.", error)
            self._checkpoint.remove()
            self._checkpoint = None


def _model(session: Session) -> ObjectModel | None:
    """The object as far as it is known; None where the session stopped in a state that gives none."""
    try:
        return session.result()
    except Exception:
        return None
