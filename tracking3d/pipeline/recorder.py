"""Objects on their way from the frames to their run folders: answered, kept, and looked at once more at the end."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.checkpoint.progress import Progress, SavedState, TakenFrame, check_picture, checksum
from tracking3d.checkpoint.serialization import NotSerializableError
from tracking3d.errors import OutputError, PluginError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame, MaskEstimate, SkippedFrame
from tracking3d.pipeline.refinement_pass import PrecomputedRefinement, RefinementPass
from tracking3d.pipeline.session import Session
from tracking3d.prompts.corrections import Correction, prompts_in
from tracking3d.reconstruction import BELIEVED, TextureView, keep_best_views, make_texture, texture_view
from tracking3d.results.mesh_export import load_model
from tracking3d.results.records import FrameRecord
from tracking3d.results.refinement_writer import RefinementWriter
from tracking3d.results.run_writer import RunWriter
from tracking3d.runtime.concurrency import BackgroundWriter
from tracking3d.segmentation.frame_window import Mask
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)


class ObjectRecorder:
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
        foreseen: What the last passes come to, where somebody else found it.
    """

    def __init__(
        self,
        session: Session,
        writer: RunWriter,
        checkpoint: Checkpoint | None = None,
        kept: SavedState | None = None,
        corrections: Mapping[int, Correction] | None = None,
        redraw: bool = False,
    ) -> None:
        self._session, self._writer, self._checkpoint = session, writer, checkpoint
        self._corrections, self._unmet = corrections or {}, set(corrections or {})
        self._redraw = redraw
        self._kept = kept
        self._work = BackgroundWriter()  # all that touches writer and checkpoint while frames come
        self.latest: FrameEstimate | None = None
        self.foreseen: PrecomputedRefinement | None = None
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
        self._last: RefinementPass | None = None
        self._views: tuple[TextureView, ...] = ()

    @contextmanager
    def writing_beside(self) -> Iterator[None]:
        """Within, answers are kept by another thread while the next frame is solved, one at a time."""
        self._work.threaded = True
        try:
            yield
        finally:
            self._work.end()

    def written(self) -> Any:
        """Wait until all answers are kept; what is to be told of the last one."""
        return self._work.wait()

    def take(
        self, frame: Frame | SkippedFrame, coming: Frame | SkippedFrame | None = None
    ) -> FrameRecord | SkippedFrame | None:
        """Answer for the next frame and keep the answer; what was answered before the run was stopped stands.

        Args:
            frame: The frame.
            coming: The one that will be taken next, where that is known.

        Returns:
            What is to be told: of this frame, or of the one before while `writing_beside`.
        """
        if isinstance(frame, Frame):
            self._unmet.discard(frame.index)
        if self._kept and frame.index in self._past:
            return self._take_kept(self._kept, frame)
        if isinstance(frame, SkippedFrame):
            return self._work.do(partial(self._skip, frame))
        if not isinstance(coming, Frame) or coming.index in self._past:
            coming = None
        self._session.coming = coming
        estimate = self._session.step(frame, *prompts_in(frame, self._corrections))
        self._answered, self.latest = True, estimate
        initial = self._session.initial_mask
        if self._session.config.solver.final_refine:
            self._initial[frame.index] = initial.score, initial.reason
        taken = state = None
        if self._checkpoint:
            taken = TakenFrame(
                frame.index,
                checksum(frame.image),
                initial.score,
                initial.reason,
                self._session.corrected,
                self._session.failure_at(frame.index),
            )
            state = self._session.kept()
        return self._work.do(partial(self._keep_answer, estimate, frame, taken, state))

    def _skip(self, frame: SkippedFrame) -> SkippedFrame:
        self._writer.skip(frame)
        if self._checkpoint:
            self._checkpoint.note(frame)
        return frame

    def _keep_answer(
        self, estimate: FrameEstimate, frame: Frame, taken: TakenFrame | None, state: dict[str, Any] | None
    ) -> FrameRecord:
        answer = self._writer.write(estimate, frame)
        if self._checkpoint and taken is not None and state is not None:
            if taken.corrected:
                self._checkpoint.keep_correction(frame.index, estimate.mask)
            self._progress = replace(self._progress, last=frame.index, lines=self._writer.lines)
            self._keep(state, taken, [one.index for one in estimate.revised])
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
            wanted, camera = self._session.config.object, self._session.camera
            self._last = RefinementPass(
                self._refinement, self._session.result(), camera, wanted.adjustment_views, wanted.refine_masks,
                self._corrections, self.foreseen,
            )  # fmt: skip
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
        self._keep(self._session.kept())

    def take_again(self, frame: Frame) -> FrameRecord | None:
        """Answer for a frame once more; None where it has no causal answer or there is no refinement."""
        refinement = self._refinement
        if refinement is None:
            self._writer.draw_again(frame)
            return None
        if frame.index not in refinement.causal:
            return None
        if self._kept:
            check_picture(self._kept, frame)
            if frame.index <= self._until.last_refined:
                answer = refinement.answer(frame.index)
                return self._work.do(partial(self._keep_views, answer, frame, refinement.mask(answer)))
        mask = refinement.initial_mask(frame.index)
        score, reason = self._initial.get(frame.index, (1.0, ""))
        initial = MaskEstimate(None if mask is None else mask.astype(np.float32), score, reason)
        estimate = None
        try:
            estimate = self._session.refine_frame(frame, initial, refinement.causal[frame.index].T_cam_obj)
        except PluginError:
            if self._session.config.runtime.on_plugin_failure == "stop":
                raise
        state = self._session.kept() if self._checkpoint else {}
        return self._work.do(partial(self._keep_second, estimate, frame, mask, state))

    def _keep_second(
        self, estimate: FrameEstimate | None, frame: Frame, initial: Mask | None, state: dict[str, Any]
    ) -> FrameRecord:
        refinement = self._refinement
        assert refinement is not None
        answer = refinement.write(estimate, frame, initial)
        self._progress = replace(self._progress, last_refined=frame.index, refined_lines=refinement.lines)
        self._keep(state)
        return self._keep_views(answer, frame, estimate.mask if estimate else refinement.mask(answer))

    def _keep_views(self, estimate: FrameRecord, frame: Frame, mask: Mask) -> FrameRecord:
        """Keep what poses, surface and texture of the end can be taken from; the answer as it is."""
        most = self._session.config.object.texture_views
        if self._last:
            self._last.see(estimate, frame.image, mask)
        if most and estimate.status is Status.TRACKED and estimate.confidence >= BELIEVED:
            camera = estimate.through(self._session.camera)
            image, seen = camera.undistort(frame.image), camera.mask_to_pinhole(mask)
            view = texture_view(frame.index, image, seen, camera, estimate.T_cam_obj)
            self._views = self._views if view is None else keep_best_views(self._views, view, most)
        return estimate

    @property
    def draws(self) -> bool:
        """Whether the frames are to come a last time, to be drawn as they are answered in the end."""
        return self._refinement is not None

    @property
    def weighs_masks(self) -> bool:
        """Whether they are to come once before that, for their masks to be weighed together."""
        return self._last is not None and self._last.weighs_masks

    def settle(self) -> None:
        """All frames were looked at again: put right together what they say."""
        if self._last:
            self._writer.refine_camera(self._last.settle())

    def put_right(self, frame: Frame) -> None:
        """Give the final answer for a frame the pose that all frames together say."""
        if self._last:
            self._last.put_right(frame)

    def draw(self, frame: Frame) -> None:
        """Draw the final answer for a frame."""
        if self._last:
            self._last.draw(frame, self._work.do)

    def finish(self) -> None:
        """Write what is made at the end."""
        model, views = self._session.result(), self._views
        if self._last:
            self._last.rest(self._work.do)
            self._work.wait()
            model, views = self._last.moved(model, views)
        model = make_texture(model, views, self._session.config.object.max_texture_size)
        if self._refinement is not None:
            self._writer.end_refinement()
            self._causal_model = None
        self._writer.finish(model, "finished")
        if self._checkpoint:
            self._checkpoint.finish()

    def pause(self) -> None:
        """Stop here; the folder is that of a stopped run, which can go on."""
        self._writer.finish(_model_so_far(self._session), "interrupted")

    def give_up(self, error: BaseException) -> None:
        """Keep what is finished when ``error`` ends the run, and let ``error`` say so."""
        self._work.end()
        failed = isinstance(error, Exception)
        folder = self._writer.folder
        if self._causal_model is not None:
            error.add_note(
                f"The final refinement was not finished; the causal answers are whole in {folder}."
            )
        elif self._answered:
            error.add_note(f"What was finished until then is kept in {folder}.")
        model = self._causal_model or _model_so_far(self._session)
        with suppress(OutputError):  # the first error is the one to tell
            self._writer.finish(model, "failed" if failed else "interrupted", str(error) or None)

    def _take_kept(self, kept: SavedState, frame: Frame | SkippedFrame) -> FrameRecord | SkippedFrame | None:
        """Draw a frame that is answered, and show it to a mask tracker that knows no other way to go on."""
        if isinstance(frame, SkippedFrame) and frame.index not in kept.taken:
            return frame
        if frame.index not in kept.taken or self._until.refining:
            return None
        check_picture(kept, frame)
        assert isinstance(frame, Frame)
        if self._session.replays:
            taken, first = kept.taken[frame.index], frame.index == next(iter(kept.taken))
            correction = None
            if taken.corrected and self._checkpoint:
                correction = self._checkpoint.correction(frame.index)
            estimate = self._session.replay(frame, first, correction, *prompts_in(frame, self._corrections))
            if (
                not self._said
                and not taken.failure
                and estimate
                and not self._writer.is_initial_mask(frame, estimate)
            ):
                self._said = True
                _log.warning(
                    "The mask tracker gives another mask of %s than before the run was stopped; what follows may "
                    "differ from a run that was not.",
                    frame.name or f"frame {frame.index}",
                )
        return self._writer.draw_again(frame)

    def _keep(
        self, state: dict[str, Any], taken: TakenFrame | None = None, revised: Iterable[int] = ()
    ) -> None:
        """Keep the session's state."""
        if self._checkpoint is None:
            return
        self._progress = replace(
            self._progress,
            seconds=self._writer.seconds,
            refinement_seconds=self._refinement.seconds if self._refinement else 0.0,
        )
        try:
            self._checkpoint.save(self._progress, state, taken, revised)
        except NotSerializableError as error:
            _log.warning("This run cannot be resumed when it is stopped: %s.", error)
            self._checkpoint.remove()
            self._checkpoint = None


def _model_so_far(session: Session) -> ObjectModel | None:
    """The object as far as it is known; None where the session stopped in a state that gives none."""
    try:
        return session.result()
    except Exception:
        return None
