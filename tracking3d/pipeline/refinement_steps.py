"""The last steps of a final refinement: what all frames together say of poses, surface and lens, and then of masks.

The steps are the same for any range of frames::

    for frame in frames: collect(frame)                # keyframes for the adjustment
    adjust_all()                                       # poses, surface and lens together
    for frame in frames: put(adjusted(frame))          # the pose of every frame
    for frame in frames: collect_mask(frame)           # masks and poses that are reliable
    settle_masks()                                     # what they have in common
    for frame in frames: decide(frame); rest()         # the mask of every frame

A run in one process takes all frames through one `RefinementSteps`. `tracking3d.submaps.parallel_refinement` takes
ranges of frames through several, in processes of their own: what is adjusted together, and the masks that are
collected, are done once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import PluginError
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.earlier_refinement import EarlierRefinement
from tracking3d.pipeline.session import Session
from tracking3d.reconstruction.confidence import assess_estimate
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment
from tracking3d.reconstruction.held_adjustment import HeldAdjustment
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.results.refinement_writer import adjusted_record
from tracking3d.segmentation.frame_window import Answered
from tracking3d.segmentation.whole_video import SegmentedMask, VideoSegmenter

Decision = tuple[Frame, SegmentedMask | None]
"""A frame that is due, and its mask; None if its present mask stays."""


@dataclass(frozen=True, eq=False)
class PrecomputedRefinement:
    """What the last steps come to, if other processes have taken them.

    Attributes:
        look: What all frames together say of poses, surface and lens.
        estimates: The estimates with adjusted poses, by frame index.
        masks: The masks that were decided, as PNG, by index; their probabilities are written.
    """

    look: GlobalAdjustment
    estimates: Mapping[int, FrameRecord]
    masks: Mapping[int, bytes]


def estimate_again(
    session: Session,
    frame: Frame,
    causal: FrameRecord,
    initial: MaskEstimate,
    earlier: EarlierRefinement | None = None,
) -> FrameEstimate | None:
    """Estimate the object in a frame again, with the final model; None if a plug-in fails and the run may continue.

    Args:
        session: Has refined everything, see `Session.refine`.
        frame: The frame; frames come in order of time.
        causal: Its causal estimate.
        initial: Its initial mask.
        earlier: The estimates that stand, if only some frames are refined.

    Raises:
        PluginError: If a plug-in fails, with ``runtime.on_plugin_failure`` ``stop``.
    """
    T_cam_obj = causal.T_cam_obj
    if earlier is not None:
        T_cam_obj = earlier.start.predict(frame.index, T_cam_obj, causal.through(session.camera).fx)
    try:
        return session.refine_frame(frame, initial, T_cam_obj)
    except PluginError:
        if session.config.runtime.on_plugin_failure == "stop":
            raise
        return None


class RefinementSteps:
    """Takes frames through the last steps of a final refinement; see the module.

    Args:
        estimates: The refined estimates of the whole video.
        look: Adjusts poses, surface and lens.
        masks: Decides masks; None until `begin_masks`.
        fixed: Indices of frames whose masks the user has given: those stand.
        earlier: The estimates that stand, if only some frames are refined.

    Attributes:
        look: As given.
        masks: As given, or begun.
    """

    def __init__(
        self,
        estimates: RefinedEstimates,
        look: GlobalAdjustment | HeldAdjustment,
        masks: VideoSegmenter | None = None,
        fixed: Collection[int] = (),
        earlier: EarlierRefinement | None = None,
    ) -> None:
        self._estimates, self._fixed, self._earlier = estimates, fixed, earlier
        self.look, self.masks = look, masks
        self._waiting: dict[int, Frame] = {}

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
        if not record.refined:
            return record
        T_cam_obj, support = self.look.pose(record, frame.image, self._visible(record))
        judged = () if support is None else assess_estimate(record, support)
        return adjusted_record(record, T_cam_obj, *judged)

    def begin_masks(self, has_given_masks: bool) -> None:
        """Begin with the masks; which poses are reliable is taken from the estimates as they are now.

        Args:
            has_given_masks: Whether the user gives the initial masks.
        """
        known = {one.index: one.confidence for one in self._estimates.all() if _has_pose(one)}
        pinhole = replace(self.look.camera, lens=None)
        due = None if self._earlier is None else self._earlier.near
        self.masks = VideoSegmenter(
            pinhole, self.look.vertices_of_landmarks, self.look.faces, known, due, has_given_masks
        )

    def collect_mask(self, frame: Frame) -> None:
        """Collect a frame's evidence for the mask, if its pose and mask are reliable; its pose is adjusted already."""
        assert self.masks is not None
        if self.masks.wants(frame.index):
            self.masks.see(self._segmentation_input(frame))

    def settle_masks(self) -> None:
        """All frames were collected: put together what their masks have in common."""
        assert self.masks is not None
        self.masks.settle()

    def decide(self, frame: Frame) -> Iterator[Decision]:
        """Take the next frame, in order of time; gives those whose turn has come."""
        assert self.masks is not None
        if self._earlier is not None and frame.index not in self._earlier.shown:
            yield from self.decide_rest()
            yield frame, None
            return
        self._waiting[frame.index] = frame
        yield from map(self._make_decision, self.masks.decide(self._segmentation_input(frame)))

    def decide_rest(self) -> Iterator[Decision]:
        """Give the frames that are left when there are no more."""
        assert self.masks is not None
        yield from map(self._make_decision, self.masks.rest())

    def _segmentation_input(self, frame: Frame) -> Answered:
        """A frame as `VideoSegmenter` takes it: through a camera without lens distortion."""
        camera, record = self.look.camera, self._estimates.estimate(frame.index)
        mask, initial = self._estimates.mask(record), self._estimates.initial_mask(frame.index)
        occluder = self._estimates.occluder(frame.index)
        return Answered(
            record.index,
            camera.undistort(frame.image),
            camera.mask_to_pinhole(np.zeros_like(mask) if initial is None else initial),
            camera.mask_to_pinhole(mask),
            record.T_cam_obj if _has_pose(record) else np.full((4, 4), np.nan),
            record.confidence,
            None if occluder is None else camera.mask_to_pinhole(occluder),
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
