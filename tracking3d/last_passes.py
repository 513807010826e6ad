"""The last steps of a final refinement: what all frames together say of poses, surface and lens, and then of masks.

The steps are the same for any range of frames::

    for frame in frames: collect(frame)                # keyframes for the adjustment
    adjust_all()                                       # poses, surface and lens together
    for frame in frames: put(adjusted(frame))          # the pose of every frame
    for frame in frames: collect_mask(frame)           # masks and poses that are reliable
    settle_masks()                                     # what they have in common
    for frame in frames: decide(frame); rest()         # the mask of every frame

A run in one process takes all frames through one `LastPasses`. `tracking3d.splitting.last_looks` takes ranges of frames
through several, in processes of their own: what is adjusted together, and the masks that are collected, are done once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import PluginError
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.evidence.hindsight import Decided, Hindsight
from tracking3d.evidence.scene import Answered
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.reconstruction.second_look import SecondLook
from tracking3d.reconstruction.support import supported_answer
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.results.refinement_writer import put_right
from tracking3d.session import Session

Decision = tuple[Frame, Decided | None]
"""A frame whose turn has come, and its mask; None if the mask that it has stands."""


@dataclass(frozen=True, eq=False)
class PrecomputedRefinement:
    """What the last steps come to, if other processes have taken them.

    Attributes:
        look: What all frames together say of poses, surface and lens.
        estimates: The estimates with adjusted poses, by frame index.
        masks: The masks that were decided, as PNG, by index; their probabilities are written.
    """

    look: SecondLook
    estimates: Mapping[int, FrameRecord]
    masks: Mapping[int, bytes]


def estimate_again(
    session: Session, frame: Frame, causal: FrameRecord, initial: MaskEstimate
) -> FrameEstimate | None:
    """Estimate the object in a frame again, with the final model; None if a plug-in fails and the run may go on.

    Args:
        session: Has refined everything, see `Session.refine`.
        frame: The frame; frames come in order of time.
        causal: Its causal estimate.
        initial: Its initial mask.

    Raises:
        PluginError: If a plug-in fails, with ``runtime.on_plugin_failure`` ``stop``.
    """
    try:
        return session.revisit(frame, initial, causal.T_cam_obj)
    except PluginError:
        if session.config.runtime.on_plugin_failure == "stop":
            raise
        return None


class LastPasses:
    """Takes frames through the last steps of a final refinement; see the module.

    Args:
        estimates: The refined estimates of the whole video.
        look: Adjusts poses, surface and lens.
        masks: Decides masks; None until `begin_masks`.
        fixed: Indices of frames whose masks the user has given: those stand.

    Attributes:
        look: As given.
        masks: As given, or begun.
    """

    def __init__(
        self,
        estimates: RefinedEstimates,
        look: SecondLook,
        masks: Hindsight | None = None,
        fixed: Collection[int] = (),
    ) -> None:
        self._estimates, self._fixed = estimates, fixed
        self.look, self.masks = look, masks
        self._waiting: dict[int, Frame] = {}

    def collect(self, frame: Frame, mask: NDArray[np.bool_] | None = None) -> None:
        """Keep a frame for the adjustment, if it is one of those that are adjusted.

        Args:
            frame: The frame.
            mask: ``(H, W)`` of its refined estimate, if it is at hand.
        """
        record = self._estimates.estimate(frame.index)
        if record.refined and self.look.wants(frame.index):
            self.look.see(record, frame.image, self._estimates.mask(record) if mask is None else mask)

    def adjust_all(self) -> Camera:
        """All frames were collected: adjust poses, surface and lens together; the final camera."""
        self.look.settle()
        return self.look.camera

    def adjusted(self, frame: Frame) -> FrameRecord:
        """The estimate of a frame with its adjusted pose; a causal one as it is."""
        record = self._estimates.estimate(frame.index)
        if not record.refined:
            return record
        T_cam_obj, support = self.look.pose(record, frame.image, self._estimates.mask(record))
        judged = () if support is None else supported_answer(record, support)
        return put_right(record, T_cam_obj, *judged)

    def begin_masks(self) -> None:
        """Begin with the masks; which poses are reliable is taken from the estimates as they are now."""
        known = {one.index: one.confidence for one in self._estimates.all() if _has_pose(one)}
        pinhole = replace(self.look.camera, lens=None)
        self.masks = Hindsight(pinhole, self.look.vertices_of_landmarks, self.look.faces, known)

    def collect_mask(self, frame: Frame) -> None:
        """Keep what a frame says of the object, if its pose and mask are reliable; its pose is adjusted already."""
        assert self.masks is not None
        if self.masks.wants(frame.index):
            self.masks.see(self._answered(frame))

    def settle_masks(self) -> None:
        """All frames were collected: put together what their masks have in common."""
        assert self.masks is not None
        self.masks.settle()

    def decide(self, frame: Frame) -> Iterator[Decision]:
        """Take the next frame, in order of time; gives those whose turn has come."""
        assert self.masks is not None
        self._waiting[frame.index] = frame
        yield from map(self._decision, self.masks.decide(self._answered(frame)))

    def rest(self) -> Iterator[Decision]:
        """Give the frames that are left when there are no more."""
        assert self.masks is not None
        yield from map(self._decision, self.masks.rest())

    def _answered(self, frame: Frame) -> Answered:
        """A frame as `Hindsight` takes it: through a camera without lens distortion."""
        camera, record = self.look.camera, self._estimates.estimate(frame.index)
        mask, initial = self._estimates.mask(record), self._estimates.initial_mask(frame.index)
        return Answered(
            record.index,
            camera.undistorted(frame.image),
            camera.mask_to_pinhole(np.zeros_like(mask) if initial is None else initial),
            camera.mask_to_pinhole(mask),
            record.T_cam_obj if _has_pose(record) else np.full((4, 4), np.nan),
            record.confidence,
        )

    def _decision(self, found: tuple[int, Decided | None]) -> Decision:
        index, decided = found
        frame = self._waiting.pop(index)
        if decided is None or index in self._fixed or not self._estimates.estimate(index).refined:
            return frame, None
        lens = self.look.camera.lens
        if lens is not None:
            probability = lens.mask_to_picture(decided.probability)
            decided = Decided(index, probability > 0.5, probability)
        return frame, decided


def _has_pose(record: FrameRecord) -> bool:
    """Whether an estimate's pose, of the final camera, is reliable enough to be used."""
    return record.refined and record.status is not Status.LOST
