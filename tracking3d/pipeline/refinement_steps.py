"""The last steps of a final refinement: what all frames together say of poses, surface and lens, and then of masks.

The steps are the same for any range of frames::

    for frame in frames: collect(frame)                # keyframes for the adjustment
    adjust_all()                                       # poses, surface and lens together
    for frame in frames: put(adjusted(frame))          # the pose of every frame
    for frame in frames: collect_mask(frame)           # masks and poses that are reliable
    settle_masks()                                     # what they have in common
    for frame in frames: decide(frame); rest()         # the mask of every frame

A run in one process takes all frames through one `RefinementSteps`. `tracking3d.pipeline.submaps.merge_step` takes
ranges of frames through several, in processes of their own: what is adjusted together, and the masks that are
collected, are done once.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, PluginError
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.estimation.segmentation.temporal_neighbours import REACH
from tracking3d.estimation.segmentation.whole_video import (
    SegmentedMask,
    VideoSegmenter,
    draw_around_masks,
)
from tracking3d.estimation.solver import LEAST_FRAMES, RefinedStart
from tracking3d.frames import Frame, mask_iou_or_none
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.frame_reading import SavedMasks
from tracking3d.pipeline.session import Session
from tracking3d.reconstruction.confidence import assess_estimate
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment, HeldAdjustment
from tracking3d.results import layout
from tracking3d.results.files import read_mask
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.results.refinement_writer import adjusted_record
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import load_own_model, read_own_records
from tracking3d.runtime.stage_times import StageTimes
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import ObjectView

Decision = tuple[Frame, SegmentedMask | None]
"""A frame that is due, and its mask; None if its present mask stays."""


@dataclass(frozen=True, eq=False)
class PrecomputedRefinement:
    """What the last steps come to, if other processes have taken them."""

    look: GlobalAdjustment  # what all frames together say of poses, surface and lens
    estimates: Mapping[int, FrameRecord]  # the estimates with adjusted poses, by frame index
    # the masks that were decided, as PNG, by index; their probabilities are written
    masks: Mapping[int, bytes]
    # the masks of frames that were estimated again after the adjustment, as PNG, by index
    retracked: Mapping[int, bytes]
    kept_masks: int = 0  # number of masks that were not segmented again because nothing contradicts them


_LOST_OVERLAP = 0.1
"""IoU of silhouette and mask that a causal pose may lose by another lens (chosen: 0 to .03 where the map stayed, .2 to
.6 on bowl_flip, whose map moved with its lens)."""


class Retracking:
    """Estimates frames again with the final model, those that need it.

    A frame that was tracked, and whose mask agrees with the mask tracker's, keeps its causal estimate at first, with
    the pose that this amounts to once the keyframes are refined. If the adjustment by landmarks turns that against the
    other frames, or the silhouette there is not that of the mask, or there are no landmarks, it is estimated again.

    Args:
        session: Has refined everything, see `Session.refine`.
        masks: The causal estimates and their initial masks.
        earlier: The estimates that stand, if only some frames are refined.

    Attributes:
        kept: Indices of the frames that keep their causal estimate at first.
        most_degrees: By which the adjustment may turn them against the others.
        least_agreement: IoU that their masks and silhouettes have to have.
    """

    def __init__(self, session: Session, masks: SavedMasks, earlier: EarlierRefinement | None = None) -> None:
        self._session, self._masks = session, masks
        self._causal, self._camera = masks.estimates.causal, session.camera
        self._start = None if earlier is None else earlier.start
        self._before: tuple[Frame, NDArray[np.float64]] | None = None
        self.kept: frozenset[int] = frozenset()
        self.most_degrees = session.config.object.retrack_angle
        self.least_agreement = least = session.config.object.mask_agreement
        if earlier is None and self.most_degrees:
            model = session.result()
            self._surface = np.asarray(model.vertices, np.float64), np.asarray(model.faces, np.int64)
            self._start = self._refined_keyframes()
            undoubted = (
                one.index
                for one in self._causal.values()
                if one.status is Status.TRACKED and (one.iou_initial is None or one.iou_initial > least)
            )
            self.kept = frozenset(filter(self._is_predictable, undoubted) if self._start else ())

    def _refined_keyframes(self) -> RefinedStart | None:
        poses = {index: T for index, T in self._session.keyframe_poses().items() if index in self._causal}
        if len(poses) < LEAST_FRAMES:
            return None
        causal = {index: self._causal[index] for index in poses}
        return RefinedStart(
            self._camera,
            self._surface[0],
            poses,
            {index: one.T_cam_obj for index, one in causal.items()},
            {index: one.through(self._camera).fx for index, one in causal.items()},
        )

    def _is_predictable(self, index: int) -> bool:
        """Whether a causal pose still explains its mask as it is predicted, if it was found through another lens."""
        record, camera = self._causal[index], self._camera
        if math.isclose(record.through(camera).fx, camera.fx):
            return True
        mask = camera.mask_to_pinhole(self._masks.estimates.mask(record))
        image, pose = np.zeros((*mask.shape, 3), np.uint8), self.predict(record)
        view = ObjectView.of_frame(index, image, mask, replace(camera, lens=None), pose, initial=mask)
        drawn = draw_around_masks(view, *self._surface, again=True)
        overlap = None if drawn is None else mask_iou_or_none(drawn.mask, drawn.silhouette)
        return (overlap or 0.0) > record.diagnostics.get("mask_iou", 1.0) - _LOST_OVERLAP

    def keep(self, index: int) -> FrameRecord | None:
        """The causal estimate of a frame as a refined one; None if it is to be estimated again."""
        if index not in self.kept:
            return None
        record = self._causal[index]
        return replace(
            record, T_cam_obj=self.predict(record), camera=None, revision=True, refined=True, seconds=0.0,
            stages=StageTimes(),
        )  # fmt: skip

    def pass_over(self, frame: Frame, T_cam_obj: NDArray[np.float64]) -> None:
        """Take notice of a frame whose refined pose ``(4, 4)`` stands."""
        self._before = frame, T_cam_obj

    def take(self, frame: Frame) -> FrameEstimate | None:
        """Estimate the object in a frame again; None if a plug-in fails and the run may continue.

        Raises:
            PluginError: If a plug-in fails, with ``runtime.on_plugin_failure`` ``stop``.
        """
        if self._before is not None:
            self._session.keep_frame(*self._before)
        self._before = None
        try:
            return self._session.refine_frame(
                frame, self._masks.of(frame), self.predict(self._causal[frame.index])
            )
        except PluginError:
            if self._session.config.runtime.on_plugin_failure == "stop":
                raise
            return None

    def take_alone(self, frame: Frame) -> FrameEstimate | None:
        """As `take`, but depending on the frame before and nothing else, so that any process can do it."""
        with self._session.state_unchanged():
            return self.take(frame)

    def predict(self, causal: FrameRecord) -> NDArray[np.float64]:
        """The pose ``(4, 4)`` that a causal estimate amounts to once the keyframes are refined."""
        if self._start is None:
            return causal.T_cam_obj
        return self._start.predict(causal.index, causal.T_cam_obj, causal.through(self._camera).fx)


class RefinementSteps:
    """Takes frames through the last steps of a final refinement; see the module.

    Args:
        estimates: The refined estimates of the whole video.
        look: Adjusts poses, surface and lens.
        masks: Decides masks; None until `begin_masks`.
        fixed: Indices of frames whose masks the user has given: those stand.
        earlier: The estimates that stand, if only some frames are refined.
        retracking: Estimates frames again that the adjustment moves; None if that was done.

    Attributes:
        look: As given.
        masks: As given, or begun.
        retracked: The masks, as PNG, of the frames that were estimated again in `adjust`, by index.
    """

    def __init__(
        self,
        estimates: RefinedEstimates,
        look: GlobalAdjustment | HeldAdjustment,
        masks: VideoSegmenter | None = None,
        fixed: Collection[int] = (),
        earlier: EarlierRefinement | None = None,
        retracking: Retracking | None = None,
    ) -> None:
        self._estimates, self._fixed, self._earlier = estimates, fixed, earlier
        self._retracking = retracking
        self.retracked: dict[int, bytes] = {}
        self.look, self.masks = look, masks
        self._waiting: dict[int, Frame] = {}
        self._drawn: Drawn | None = None  # the latest frame as adjusted, if its silhouette was asked for

    def collect(self, frame: Frame, mask: NDArray[np.bool_] | None = None) -> None:
        """Keep a frame for the adjustment, if it is one of those that are adjusted.

        Args:
            frame: The frame.
            mask: ``(H, W)`` what its refined estimate shows of the object, if it is at hand.
        """
        record = self._estimates.estimate(frame.index)
        if record.refined and self.look.wants(frame.index):
            self.look.see(record, frame.image, self._visible(record) if mask is None else mask)

    def adjust_all(self) -> Camera:
        """All frames were collected: adjust poses, surface and lens together; the final camera."""
        self.look.settle()
        return self.look.camera

    def adjust(self, frame: Frame) -> FrameRecord:
        """The estimate of a frame with its adjusted pose; a causal one as it is."""
        record = self._estimates.estimate(frame.index)
        self._drawn = None
        if not record.refined:
            return record
        T_cam_obj, support = self.look.pose(record, frame.image, self._visible(record))
        if self._retracking is not None and isinstance(self.look, GlobalAdjustment):
            again = None
            if frame.index in self._retracking.kept and self._needs_retracking(record, frame, T_cam_obj):
                again = self._retracking.take_alone(frame)
            self._retracking.pass_over(frame, record.T_cam_obj)
            if again is not None:
                self._drawn = None
                self.retracked[frame.index] = self._estimates.put_retracked(again, frame.name)
                record = self._estimates.estimate(frame.index)
                T_cam_obj, support = self.look.pose(record, frame.image, self._visible(record))
        judged = () if support is None else assess_estimate(record, support)
        return adjusted_record(record, T_cam_obj, *judged)

    def _needs_retracking(self, record: FrameRecord, frame: Frame, T_cam_obj: NDArray[np.float64]) -> bool:
        """Whether the adjusted pose contradicts a causal estimate: its pose, or by the silhouette its mask."""
        assert isinstance(self.look, GlobalAdjustment) and self._retracking is not None
        if self.look.deviation(record, T_cam_obj) > self._retracking.most_degrees:
            return True
        surface = self.look.vertices_of_landmarks, self.look.faces
        view = self._segmentation_input(frame, T_cam_obj)
        self._drawn = drawn = draw_around_masks(view, *surface, again=True)
        agreement = None if drawn is None else mask_iou_or_none(drawn.mask, drawn.silhouette)
        return (agreement or 0.0) <= self._retracking.least_agreement

    def begin_masks(self, config: PipelineConfig) -> None:
        """Begin with the masks; which poses are reliable is taken from the estimates as they are now.

        Frames from before the first map, which were answered when it came, have their masks decided in any case, and
        given masks decide what becomes of all.
        """
        given = config.has_given_masks
        may_keep = () if given else [one.index for one in self._estimates.causal.values() if not one.revision]
        known = {one.index: one.confidence for one in self._estimates.all() if _has_pose(one)}
        pinhole = replace(self.look.camera, lens=None)
        due = None if self._earlier is None else self._earlier.near
        surface = self.look.vertices_of_landmarks, self.look.faces
        agreement = config.object.mask_agreement
        self.masks = VideoSegmenter(pinhole, *surface, known, due, given, frozenset(may_keep), agreement)

    def collect_mask(self, frame: Frame) -> None:
        """Collect a frame's evidence for the mask, if its pose and mask are reliable; its pose is adjusted already."""
        assert self.masks is not None
        drawn = None if self._drawn is None or self._drawn.index != frame.index else self._drawn
        self.masks.see(drawn or self._segmentation_input(frame))

    def settle_masks(self) -> None:
        """All frames were collected: put together what their masks have in common."""
        assert self.masks is not None
        self.masks.settle()

    def decide(self, frame: Frame) -> Iterator[Decision]:
        """Take the next frame, in order of time; gives those whose turn has come."""
        assert self.masks is not None
        if not self.masks.needs(frame.index):
            yield from self.decide_rest()
            yield frame, None
            return
        self._waiting[frame.index] = frame
        yield from map(self._make_decision, self.masks.decide(self._segmentation_input(frame)))

    def decide_rest(self) -> Iterator[Decision]:
        """Give the frames that are left when there are no more."""
        assert self.masks is not None
        yield from map(self._make_decision, self.masks.rest())

    def _segmentation_input(self, frame: Frame, T_cam_obj: NDArray[np.float64] | None = None) -> ObjectView:
        """A frame as `VideoSegmenter` takes it, through a camera without distortion; at another pose if given."""
        camera, record = self.look.camera, self._estimates.estimate(frame.index)
        mask, initial = self._estimates.mask(record), self._estimates.initial_mask(frame.index)
        occluder = self._estimates.occluder(frame.index)
        T_cam_obj = record.T_cam_obj if T_cam_obj is None else T_cam_obj
        return ObjectView.of_frame(
            record.index,
            camera.undistort(frame.image),
            camera.mask_to_pinhole(mask),
            camera,
            T_cam_obj if _has_pose(record) else np.full((4, 4), np.nan),
            initial=camera.mask_to_pinhole(np.zeros_like(mask) if initial is None else initial),
            occluder=None if occluder is None else camera.mask_to_pinhole(occluder),
            confidence=record.confidence,
        )

    def _visible(self, record: FrameRecord) -> NDArray[np.bool_]:
        return self._estimates.visible(record.index, self._estimates.mask(record))

    def _make_decision(self, found: tuple[int, SegmentedMask | None]) -> Decision:
        index, decided = found
        frame = self._waiting.pop(index)
        if decided is None or index in self._fixed or not self._estimates.estimate(index).refined:
            return frame, None
        lens, initial = self.look.camera.lens, self._estimates.initial_mask(index)
        if decided.is_initial and initial is not None:  # without a way through the pinhole camera and back
            decided = SegmentedMask(index, initial, initial.astype(np.float32), is_initial=True)
        elif lens is not None:
            probability = lens.mask_to_picture(decided.probability)
            decided = SegmentedMask(index, probability > 0.5, probability)
        return frame, decided


def _has_pose(record: FrameRecord) -> bool:
    """Whether an estimate's pose, of the final camera, is reliable enough to be used."""
    return record.refined and record.status is not Status.LOST


_LEAST_SHARE = 0.5
"""Of the frames; if fewer keep their estimates, the whole video is refined again."""
_ROUNDING = 1e-6  # by which poses of equal estimates differ


@dataclass(frozen=True, eq=False)
class EarlierRefinement:
    """The refined estimates that stand."""

    folder: Path  # the run folder that they are in
    start: RefinedStart  # their poses, and the surface
    kept: Mapping[int, FrameRecord]  # their records by frame index
    changed: tuple[int, ...]  # indices of the other frames, ascending

    @cached_property
    def near(self) -> frozenset[int]:
        """The frames whose masks are decided again: those that changed, and those in whose motion cue they are."""
        order = sorted((*self.kept, *self.changed))
        place = {index: at for at, index in enumerate(order)}
        return frozenset(
            order[at]
            for index in self.changed
            for at in range(max(place[index] - REACH, 0), min(place[index] + REACH + 1, len(order)))
        )


def find_earlier_refinement(
    folder: Path, stage: Path, causal: Mapping[int, FrameRecord]
) -> EarlierRefinement | None:
    """What stands of the final refinement of a run that is being corrected; None if that is too little.

    Args:
        folder: The run as it was before the correction.
        stage: The corrected run, with causal estimates so far.
        causal: These, by frame index.
    """
    try:
        run, before = RunReader(folder), RunReader(folder, refined=False)
        refined = {one.index: one for one in read_own_records(run) if one.refined}
        earlier = {one.index: one for one in read_own_records(before)}
        online = folder / layout.ONLINE
        model = load_own_model(run, online if (online / layout.FEATURES).is_file() else folder)
        camera = run.camera
    except InputError:  # there is no refined mesh, or the run is damaged
        return None
    kept = {
        index: refined[index]
        for index, one in causal.items()
        if index in refined and index in earlier
        and _equal(one, earlier[index]) and _same_masks(stage, before, index)
        and np.isfinite(refined[index].T_cam_obj).all()
    }  # fmt: skip
    if len(kept) < max(LEAST_FRAMES, _LEAST_SHARE * len(causal)):
        return None
    start = RefinedStart(
        camera,
        np.asarray(model.vertices, np.float64),
        {index: one.T_cam_obj for index, one in kept.items()},
        {index: causal[index].T_cam_obj for index in kept},
        {index: causal[index].through(camera).fx for index in kept},
    )
    changed = tuple(sorted(causal.keys() - kept.keys()))
    return EarlierRefinement(folder, start, kept, changed)


def _equal(one: FrameRecord, other: FrameRecord) -> bool:
    same = (one.status, one.camera is None) == (other.status, other.camera is None)
    cameras = one.camera is None or np.allclose(one.camera, other.camera or 0)
    return bool(
        same and cameras and np.allclose(one.T_cam_obj, other.T_cam_obj, rtol=_ROUNDING, atol=_ROUNDING)
    )


def _same_masks(stage: Path, before: RunReader, index: int) -> bool:
    """Whether estimated and initial mask of a frame are what they were."""
    pairs = (
        (layout.mask_path(stage, index), before.mask_path(index)),
        (layout.initial_mask_path(stage, index), layout.initial_mask_path(before.folder, index)),
    )
    return all(_equal_masks(one, other) for one, other in pairs)


def _equal_masks(one: Path, other: Path) -> bool:
    try:
        if one.samefile(other):
            return True
    except OSError:
        return not one.exists() and not other.exists()
    first, second = read_mask(one), read_mask(other)
    return first is not None and second is not None and np.array_equal(first, second)
