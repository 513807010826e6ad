"""The second passes of one object: it is estimated again in every frame, and adjusted by all frames together."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame
from tracking3d.pipeline.frame_reading import SavedMasks
from tracking3d.pipeline.open_tracking import TrackedObject
from tracking3d.pipeline.refinement_steps import (
    Decision,
    EarlierRefinement,
    PrecomputedRefinement,
    RefinementSteps,
    Retracking,
)
from tracking3d.reconstruction import keep_best_views, texture_view
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment, HeldAdjustment
from tracking3d.rendering.backend import share_threads
from tracking3d.results.checkpoint.progress import check_picture
from tracking3d.results.checkpoint.run_state import RunState
from tracking3d.results.files import decode_mask
from tracking3d.results.records import FrameRecord
from tracking3d.results.refinement_writer import RefinementWriter
from tracking3d.results.run_writer import RunWriter
from tracking3d.runtime.concurrency import BackgroundWriter
from tracking3d.runtime.stage_times import measure
from tracking3d.scene.view import Mask, ObjectView


class FinalRefinement:
    """Takes one object's frames through the second passes; everything is solved with the final model already.

    Args:
        tracked: The object; its session is refined, see `Session.refine`.
        writer: The writer of the run.
        estimates: Writes the refined estimates.
        state: How far the run is.
        work: Writes in another thread while the next frame is solved.
        masks: The initial masks.
        precomputed: What the last steps come to, if other processes have taken them.
        earlier: The estimates that stand, if only some frames are refined.
    """

    def __init__(
        self,
        tracked: TrackedObject,
        writer: RunWriter,
        estimates: RefinementWriter,
        state: RunState,
        work: BackgroundWriter,
        masks: SavedMasks,
        precomputed: PrecomputedRefinement | None = None,
        earlier: EarlierRefinement | None = None,
    ) -> None:
        self._session, self._writer, self._estimates = tracked.session, writer, estimates
        self._state, self._work = state, work
        self._views: tuple[ObjectView, ...] = ()
        self._precomputed, self._earlier = precomputed, earlier
        wanted, camera = self._session.config.object, self._session.camera
        look: GlobalAdjustment | HeldAdjustment
        if precomputed is not None:
            look = precomputed.look
        elif earlier is not None:
            look = HeldAdjustment(self._session.result(), camera, sorted(earlier.kept), earlier.changed)
        else:
            causal = sorted(estimates.causal)
            look = GlobalAdjustment(self._session.result(), camera, causal, wanted.adjustment_views)
        self._retracking = Retracking(self._session, masks, earlier)
        self._last = RefinementSteps(
            estimates, look, fixed=tracked.corrections, earlier=earlier, retracking=self._retracking
        )

    @property
    def frames_again(self) -> frozenset[int]:
        """Indices of the frames that the next pass changes, as far as is known; the others stand."""
        stand = self._retracking.kept if self._last.masks is None else self._last.masks.kept
        return frozenset(self._estimates.causal).difference(
            self._earlier.kept if self._earlier else (), stand
        )

    def take_again(self, frame: Frame) -> FrameRecord | None:
        """Estimate the object in a frame again, unless its estimate stands; None if it has no causal estimate."""
        estimates, state, earlier = self._estimates, self._state, self._earlier
        if frame.index not in estimates.causal:
            return None
        if earlier is not None and (record := earlier.kept.get(frame.index)) is not None:
            self._retracking.pass_over(frame, record.T_cam_obj)
            return self._work.do(partial(self._keep, record, frame, earlier.folder))
        if state.kept:
            check_picture(state.kept, frame)
            if frame.index <= state.before.last_refined:
                record = estimates.estimate(frame.index)
                return self._work.do(partial(self._collect, record, frame, estimates.mask(record)))
        if (record := self._retracking.keep(frame.index)) is not None:
            self._retracking.pass_over(frame, record.T_cam_obj)
            return self._work.do(partial(self._keep, record, frame, self._writer.folder))
        estimate, mask = self._retracking.take(frame), estimates.initial_mask(frame.index)
        # A stopped refinement of some frames is begun again.
        kept = self._session.state_dict() if state.checkpoint and earlier is None else {}
        return self._work.do(partial(self._write_refined, estimate, frame, mask, kept))

    def _write_refined(
        self, estimate: FrameEstimate | None, frame: Frame, initial: Mask | None, session: dict[str, Any]
    ) -> FrameRecord:
        estimates = self._estimates
        record = estimates.write(estimate, frame, initial)
        if session:
            self._state.advance(
                session,
                last_refined=frame.index,
                refined_lines=estimates.lines,
                seconds=self._writer.seconds,
                refinement_seconds=estimates.seconds,
            )
        return self._collect(record, frame, estimate.mask if estimate else estimates.mask(record))

    def _keep(self, record: FrameRecord, frame: Frame, folder: Path) -> FrameRecord:
        self._estimates.keep(record, folder)
        return self._collect(record, frame, self._estimates.mask(record))

    def _collect(self, record: FrameRecord, frame: Frame, mask: Mask) -> FrameRecord:
        """Keep what the final poses, surface and texture can be taken from; the record as it is."""
        most = self._session.config.object.texture_views
        visible = self._estimates.visible(frame.index, mask)
        if self._precomputed is None:
            self._last.collect(frame, visible)
        if most and record.status is Status.TRACKED:
            camera = record.through(self._session.camera)
            image, seen = camera.undistort(frame.image), camera.mask_to_pinhole(visible)
            view = texture_view(ObjectView.of_frame(frame.index, image, seen, camera, record.T_cam_obj))
            self._views = self._views if view is None else keep_best_views(self._views, view, most)
        return record

    def adjust_all(self) -> None:
        """All frames were taken again: adjust poses, surface and lens together."""
        self._writer.begin_pass("landmarks")
        self._state.save()
        if self._earlier is None and self._retracking.kept:  # nothing was saved with the frames that are kept
            done = {"last_refined": max(self._estimates.causal), "refined_lines": self._estimates.lines}
            self._state.save(self._session.state_dict(), **done, refinement_seconds=self._estimates.seconds)
        if self._precomputed is not None:
            self._write_precomputed(self._precomputed)
        else:
            with share_threads(cv2.getNumThreads()), measure("map") as watch:
                self._last.adjust_all()
            self._estimates.together += watch.times
            if self._session.config.object.segments_again:
                self._last.begin_masks(self._session.config)
        self._writer.refine_camera(self._last.look.camera)
        self._writer.begin_pass("poses")

    def _write_precomputed(self, precomputed: PrecomputedRefinement) -> None:
        """Take over poses and masks; frames are then only drawn."""
        for record in precomputed.estimates.values():
            self._estimates.put(record, precomputed.retracked.get(record.index))
        for index, png in precomputed.masks.items():
            if (mask := decode_mask(png)) is not None:
                self._estimates.put_mask(index, mask)

    @property
    def passed_over(self) -> dict[str, int]:
        """How many frames each pass has left as they were, by its name."""
        done, masks = self._precomputed, self._last.masks
        again = self._last.retracked if done is None else done.retracked
        kept = done.kept_masks if done else len(masks.kept) if masks else 0
        return {"retracking": len(self._retracking.kept) - len(again), "masks": kept}

    @property
    def records(self) -> Iterable[FrameRecord]:
        """The estimates as they are now."""
        return self._estimates.all()

    @property
    def decides_masks(self) -> bool:
        """Whether the frames are to come once for `collect_mask` before they are drawn."""
        return self._last.masks is not None

    def collect_mask(self, frame: Frame) -> None:
        """Adjust the pose of a frame, and collect its evidence for the object's masks."""
        if self._last.masks is not None and frame.index in self._estimates.causal:
            if self._earlier is None or frame.index not in self._earlier.kept:
                self._estimates.put(self._last.adjust(frame))
            self._last.collect_mask(frame)

    def settle_masks(self) -> None:
        """Put together what the masks of all frames have in common, if masks are decided."""
        if self._last.masks is not None:
            self._writer.begin_pass("masks")
            with measure("map") as watch:
                self._last.settle_masks()
            self._estimates.together += watch.times

    def draw(self, frame: Frame) -> None:
        """Draw the final estimate of a frame; if masks are decided, of those frames whose turn has come."""
        if frame.index not in self._estimates.causal:
            return
        if self._last.masks is not None:
            with measure("map") as watch:
                decided = list(self._last.decide(frame))
            self._draw_decided(decided)
            self._estimates.together += watch.times
            return
        if self._precomputed is None:
            self._estimates.put(self._last.adjust(frame))
        self._draw(frame, self._estimates.mask(self._estimates.estimate(frame.index)))

    def draw_rest(self) -> None:
        """Draw the frames that are left when there are no more to come."""
        if self._last.masks is not None:
            with measure("map") as watch:
                decided = list(self._last.decide_rest())
            self._draw_decided(decided)
            self._estimates.together += watch.times

    def final_model(self) -> tuple[ObjectModel, tuple[ObjectView, ...]]:
        """The model with the adjusted surface, and the views of its texture with adjusted poses."""
        model, look = self._session.result(), self._last.look
        views = tuple(look.seen_by(view, self._estimates.estimate(view.index)) for view in self._views)
        return look.moved(model), views

    def _draw_decided(self, decisions: Iterable[Decision]) -> None:
        for frame, decided in decisions:
            if decided is None:
                self._draw(frame, self._estimates.mask(self._estimates.estimate(frame.index)))
            else:
                self._estimates.put_mask(frame.index, decided.mask, decided.probability)
                self._draw(frame, decided.mask)

    def _draw(self, frame: Frame, mask: Mask) -> None:
        initial = self._estimates.initial_mask(frame.index)
        self._work.do(partial(self._estimates.draw, frame, mask, initial))
