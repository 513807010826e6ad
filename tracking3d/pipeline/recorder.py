"""One object on its way from the frames to its run folder: estimated, written, and refined at the end."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from tracking3d.errors import OutputError
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.pipeline.final_refinement import FinalRefinement
from tracking3d.pipeline.frame_reading import SavedMasks
from tracking3d.pipeline.lost_frames import explain_lost_frames
from tracking3d.pipeline.open_tracking import TrackedObject
from tracking3d.pipeline.refinement_steps import (
    EarlierRefinement,
    PrecomputedRefinement,
    find_earlier_refinement,
)
from tracking3d.pipeline.session import Session
from tracking3d.reconstruction import bake_texture, close_unseen
from tracking3d.reconstruction.final_shape import is_reconstructed
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import finish_state
from tracking3d.results.checkpoint.progress import JournalEntry, SavedState, check_picture, checksum
from tracking3d.results.checkpoint.run_state import RunState
from tracking3d.results.files import read_mask
from tracking3d.results.mesh_export import load_model
from tracking3d.results.records import FrameRecord
from tracking3d.results.refinement_writer import RefinementWriter
from tracking3d.results.run_writer import RunWriter, is_initial_mask
from tracking3d.runtime.concurrency import BackgroundWriter
from tracking3d.runtime.progress import report_progress
from tracking3d.trackers.prompts.corrections import UnmetCorrections, prompts_in
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)
_MAX_PROVISIONAL_SIZE = 512
"""Most texels along a side of a texture that the one of the final shape replaces."""


class ObjectRecorder:
    """One object on its way from the frames to its run folder.

    Args:
        tracked: The object.
        writer: Writes the run folder.
        state: How far the run is; the session was given the state of the stopped run, if there is one.
        redraw: Whether frames come in another order than that of time, and are drawn once more in that order.
        temporary: Whether the run folder is removed in the end, so that errors do not name it.
        corrected: The folder of the run before it was corrected, if a correction is computed.

    Attributes:
        latest: The estimate for the frame that was taken last.
        refinement: The second passes; None before `begin_refinement`, and if there are none.
        precomputed: What the last steps come to, if other processes have computed it.
    """

    def __init__(
        self,
        tracked: TrackedObject,
        writer: RunWriter,
        state: RunState,
        redraw: bool = False,
        temporary: bool = False,
        corrected: Path | None = None,
    ) -> None:
        self._tracked, self._session = tracked, tracked.session
        self._corrected = corrected
        self._earlier: EarlierRefinement | None = None
        self._writer, self._state = writer, state
        self._redraw, self._temporary = redraw, temporary
        self._work = BackgroundWriter()  # all that touches writer and state while frames come
        self._unmet = UnmetCorrections(tracked.corrections)
        self._answered = state.kept is not None
        self._warned = False
        self._initial: dict[int, tuple[float, str]] = {}
        if state.kept and self._refines:
            self._initial = {one.index: (one.score, one.reason) for one in state.kept.taken.values()}
        self._causal_model: ObjectModel | None = None
        self.latest: FrameEstimate | None = None
        self.refinement: FinalRefinement | None = None
        self.precomputed: PrecomputedRefinement | None = None

    @contextmanager
    def writing_beside(self) -> Iterator[None]:
        """Within, estimates are written by another thread while the next frame is solved, one at a time."""
        self._work.threaded = True
        try:
            yield
        finally:
            self._work.end()

    def wait_until_written(self) -> Any:
        """Wait until all estimates are written; returns the last one for the listener."""
        return self._work.wait()

    @property
    def needs_first_pass(self) -> bool:
        """Whether the frames are to come for the first time, or for the mask tracker to see them again."""
        return not self._state.before.refining

    def take(
        self, frame: Frame | SkippedFrame, coming: Frame | SkippedFrame | None = None
    ) -> FrameRecord | SkippedFrame | None:
        """Estimate the object in the next frame and write the estimate; estimates of a resumed run stay.

        Args:
            frame: The frame.
            coming: The one that will be taken next, if it is known.

        Returns:
            The frame for the listener: this one, or the one before while `writing_beside`.
        """
        self._unmet.see(frame)
        if self._state.kept and self._state.has(frame.index):
            return self._replay_saved(self._state.kept, frame, coming)
        if isinstance(frame, SkippedFrame):
            return self._work.do(partial(self._skip, frame))
        if not isinstance(coming, Frame) or self._state.has(coming.index):
            coming = None
        self._session.coming = coming
        estimate = self._session.step(frame, *prompts_in(frame, self._tracked.corrections))
        self._answered, self.latest = True, estimate
        initial = self._session.initial_mask
        if self._refines:
            self._initial[frame.index] = initial.score, initial.reason
        taken = kept = None
        if self._state.checkpoint:
            taken = JournalEntry(
                frame.index,
                checksum(frame.image),
                initial.score,
                initial.reason,
                self._session.corrected,
                self._session.failure_at(frame.index),
                initial.carried,
            )
            kept = self._session.state_dict()
        return self._work.do(partial(self._write, estimate, frame, taken, kept))

    def _skip(self, frame: SkippedFrame) -> SkippedFrame:
        self._writer.skip(frame)
        if self._state.checkpoint:
            self._state.checkpoint.note(frame)
        return frame

    def _write(
        self,
        estimate: FrameEstimate,
        frame: Frame,
        taken: JournalEntry | None,
        session: dict[str, Any] | None,
    ) -> FrameRecord:
        record, checkpoint = self._writer.write(estimate, frame), self._state.checkpoint
        if checkpoint and taken is not None and session is not None:
            if taken.corrected:
                checkpoint.keep_correction(frame.index, estimate.visible_mask)
            revised = [one.index for one in estimate.revised]
            so_far = {"lines": self._writer.lines, "seconds": self._writer.seconds}
            self._state.advance(session, taken, revised, last=frame.index, **so_far)
        return record

    def _replay_saved(
        self, kept: SavedState, frame: Frame | SkippedFrame, coming: Frame | SkippedFrame | None
    ) -> FrameRecord | SkippedFrame | None:
        """Draw a frame that has its estimate, and show it to a mask tracker that cannot be resumed otherwise."""
        if isinstance(frame, SkippedFrame) and frame.index not in kept.taken:
            return frame
        if frame.index not in kept.taken or not self.needs_first_pass:
            return None
        check_picture(kept, frame)
        assert isinstance(frame, Frame)
        if self._session.replays:
            self._session.coming = None
            if isinstance(coming, Frame) and (after := kept.taken.get(coming.index)) and not after.carried:
                self._session.coming = coming
            self._replay(kept, frame)
        if self._corrected is not None and self._refines:
            return self._writer.kept_record(
                frame.index
            )  # drawn once it is refined; nobody looks at the copy before
        return self._writer.draw_again(frame)

    def _replay(self, kept: SavedState, frame: Frame) -> None:
        """Show a frame to the mask tracker again; warn once if the tracker gives another mask than before."""
        taken, first = kept.taken[frame.index], frame.index == next(iter(kept.taken))
        correction = carried = None
        if taken.carried:
            carried = read_mask(layout.initial_mask_path(self._writer.folder, frame.index))
        if taken.corrected and self._state.checkpoint:
            correction = self._state.checkpoint.correction(frame.index)
        prompt = next(iter(prompts_in(frame, self._tracked.corrections)), None)
        mask = self._session.replay(frame, first, correction, prompt, carried)
        if self._warned or taken.failure or not mask or is_initial_mask(self._writer.folder, frame, mask):
            return
        self._warned = True
        _log.warning(
            "The mask tracker gives another mask of %s than before the run was stopped; what follows may differ from a "
            "run that was not.",
            frame.name or f"frame {frame.index}",
        )

    @property
    def _refines(self) -> bool:
        """Whether a final refinement is asked for."""
        return self._session.config.solver.final_refine

    def begin_refinement(self, source: FrameSource) -> None:
        """All frames were taken: refine everything, or record why not though it was asked for."""
        self._unmet.warn()
        self._write_late_estimates()
        self._state.save()
        estimates = self._open_refinement(source)
        if estimates is not None:
            estimates.together = self._session.refining
            self._writer.refine_camera(self._session.camera)
            self.refinement = FinalRefinement(
                self._tracked,
                self._writer,
                estimates,
                self._state,
                self._work,
                SavedMasks(estimates, self._initial),
                self.precomputed,
                self._earlier,
            )
            self._writer.begin_pass("retracking")
        elif self._redraw:
            self._writer.begin_drawing_again()

    def _open_refinement(self, source: FrameSource) -> RefinementWriter | None:
        """Refine everything, unless the stopped run has done so; None if there is no refinement."""
        before = self._state.before
        if before.refining:
            estimates = self._writer.begin_refinement(None, before.refined_lines, before.refinement_seconds)
            self._causal_model = load_model(
                self._writer.folder
            )  # in its place again, if it was being replaced
            return estimates
        if not self._refines:
            return None
        if not self._session.can_refine or not source.repeatable:
            self._writer.skip_refinement(
                f"{source.name} cannot be read a second time"
                if self._session.can_refine
                else f"the solver {self._session.config.solver.name} gives causal estimates only"
            )
            return None
        report_progress("refining the map")
        self._writer.begin_pass("lost frames")
        self._causal_model = self._session.result()
        estimates = self._writer.begin_refinement(self._causal_model)
        if self._continue_earlier(estimates):
            return estimates
        masks = SavedMasks(estimates, self._initial)
        estimates.start = explain_lost_frames(self._session, source, masks)
        report_progress("refining the map")
        self._writer.begin_pass("map")
        self._session.refine()
        self._state.save(
            self._session.state_dict(),
            refining=True,
            seconds=self._writer.seconds,
            refinement_seconds=estimates.seconds,
        )
        return estimates

    def _continue_earlier(self, estimates: RefinementWriter) -> bool:
        """If this corrects a run, and most of its refined estimates stand, start from these; whether it was done."""
        if self._corrected is None:
            return False
        earlier = find_earlier_refinement(self._corrected, self._writer.folder, estimates.causal)
        if earlier is None or not self._session.continue_refinement(earlier.start):
            _log.info("The correction changes most of the run: the final refinement takes all frames again.")
            return False
        self._earlier = earlier
        _log.info(
            "The final refinement takes %d frames again; the others keep their estimates.",
            len(earlier.changed),
        )
        return True

    @property
    def needs_second_pass(self) -> bool:
        """Whether the frames are to come once more, in order of time."""
        return self.refinement is not None or self._redraw

    def take_again(self, frame: Frame) -> FrameRecord | None:
        """Estimate the object in a frame again; without a refinement, only draw the frame, and give None."""
        if self.refinement is not None:
            return self.refinement.take_again(frame)
        self._writer.draw_again(frame)
        return None

    def finish(self, source: FrameSource) -> None:
        """Write the final files; ``source`` is the video."""
        model, largest = self._session.result(), self._session.config.object.max_texture_size
        if self.refinement is not None:
            self.refinement.draw_rest()
            self._work.wait()
            self._writer.begin_pass("model")
            surface, views = self.refinement.final_model()
            # With `fine` and `extends` the reconstruction may be refused, and this texture stays.
            config = self._session.config
            replaced = config.object.shape == "auto" and config.object.extends is None
            replaced = replaced and is_reconstructed(self.refinement.records, config, source)
            largest = min(largest, _MAX_PROVISIONAL_SIZE) if replaced else largest
            model = close_unseen(bake_texture(surface, views, largest, details=not replaced))
            self._writer.end_refinement(self.refinement.passed_over)
            self._causal_model = None
        report_progress("writing the model")
        self._writer.finish(model, "finished")
        if self._state.checkpoint:
            finish_state(self._writer.folder)

    def pause(self) -> None:
        """Stop here; the folder is that of a stopped run, which can be resumed."""
        self._state.save()
        self._writer.finish(_model_so_far(self._session), "interrupted")

    def give_up(self, error: BaseException) -> None:
        """Save the finished frames when ``error`` ends the run, and add this to ``error``."""
        self._work.end()
        with suppress(Exception):  # the first error is reported
            self._write_late_estimates()
        with suppress(Exception):
            self._state.save()
        failed = isinstance(error, Exception)
        folder = self._writer.folder
        if self._causal_model is not None and not self._temporary:
            error.add_note(
                f"The final refinement was not finished; the causal estimates are whole in {folder}."
            )
        elif self._answered and not self._temporary:
            error.add_note(f"The frames finished until then are in {folder}.")
        model = self._causal_model or _model_so_far(self._session)
        with suppress(OutputError):  # the first error is reported
            self._writer.finish(model, "failed" if failed else "interrupted", str(error) or None)

    def _write_late_estimates(self) -> None:
        """Write the estimates that a live session has computed in the background since its last frame."""
        for late in self._session.finish_background_work():
            self._writer.record(late, "", revision=True)
            self._writer.use_camera(self._session.camera)


def _model_so_far(session: Session) -> ObjectModel | None:
    """The object as far as it is known; None if the session stopped in a state that gives none."""
    try:
        return session.result()
    except Exception:
        return None
