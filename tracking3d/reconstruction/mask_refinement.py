"""Masks weighed against the image once more, when all frames of a video have been looked at again.

`tracking3d.segmentation.whole_video` knows pinhole cameras, masks and poses; here are the run's answers and its lens.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Status
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.results.records import FrameRecord
from tracking3d.segmentation.frame_window import Answered
from tracking3d.segmentation.whole_video import SegmentedMask, VideoSegmenter


@dataclass(frozen=True, eq=False)
class Masked:
    """A frame as it was answered.

    Attributes:
        frame: The frame.
        answer: Its answer, the pose put right.
        initial: ``(H, W)`` the mask tracker's mask, or None.
        mask: ``(H, W)`` the answer's.
        fixed: Whether the user has said where the object is: that stands.
    """

    frame: Frame
    answer: FrameRecord
    initial: NDArray[np.bool_] | None
    mask: NDArray[np.bool_]
    fixed: bool = False


Decision = tuple[Masked, SegmentedMask | None]
"""A frame whose turn has come, and its mask; None where the answer stands."""


class MaskRefinement:
    """The frames as they come by twice more: to be put together, and to be decided.

    Args:
        camera: Of the full frame, as it is in the end.
        vertices: ``(V, 3)`` of the final object.
        faces: ``(F, 3)``.
        estimates: Of all frames.
    """

    def __init__(
        self,
        camera: Camera,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int64],
        estimates: Sequence[FrameRecord],
    ) -> None:
        self._camera = camera
        known = {one.index: one.confidence for one in estimates if _has_pose(one)}
        self._hindsight = VideoSegmenter(replace(camera, lens=None), vertices, faces, known)
        self._settled = False
        self._waiting: dict[int, Masked] = {}

    def wants(self, index: int) -> bool:
        """Whether a frame is to be seen for the first time; the others need not."""
        return self._hindsight.wants(index)

    def see(self, masked: Masked) -> None:
        """A frame for the first time."""
        self._hindsight.see(self._answered(masked))

    def settle(self) -> None:
        """All frames that are wanted were seen: put together what they say, unless that is done."""
        if not self._settled:
            self._hindsight.settle()
            self._settled = True

    def decide(self, masked: Masked) -> Iterator[Decision]:
        """A frame for the second time, in the order of time; yields those whose turn has come."""
        self.settle()
        self._waiting[masked.frame.index] = masked
        yield from map(self._decision, self._hindsight.decide(self._answered(masked)))

    def rest(self) -> Iterator[Decision]:
        """Those that are left when there are no more frames."""
        yield from map(self._decision, self._hindsight.rest())

    def _answered(self, masked: Masked) -> Answered:
        camera, estimate = self._camera, masked.answer
        initial = np.zeros_like(masked.mask) if masked.initial is None else masked.initial
        return Answered(
            estimate.index,
            camera.undistort(masked.frame.image),
            camera.mask_to_pinhole(initial),
            camera.mask_to_pinhole(masked.mask),
            estimate.T_cam_obj if _has_pose(estimate) else np.full((4, 4), np.nan),
            estimate.confidence,
        )

    def _decision(self, found: tuple[int, SegmentedMask | None]) -> Decision:
        index, decided = found
        masked = self._waiting.pop(index)
        if decided is None or masked.fixed or not masked.answer.refined:
            return masked, None
        lens = self._camera.lens
        if lens is not None:
            probability = lens.mask_to_picture(decided.probability)
            decided = SegmentedMask(index, probability > 0.5, probability)
        return masked, decided


def _has_pose(estimate: FrameRecord) -> bool:
    """Whether an answer's pose, of the camera of the end, is one to go by."""
    return estimate.refined and estimate.status is not Status.LOST
