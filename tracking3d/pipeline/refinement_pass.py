"""What becomes of an object's answers once all frames were looked at again: poses, then masks, then pictures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Frame, Image
from tracking3d.geometry.camera import Camera
from tracking3d.reconstruction.confidence import assess_estimate
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment
from tracking3d.reconstruction.mask_refinement import Decision, Masked, MaskRefinement
from tracking3d.reconstruction.views import TextureView
from tracking3d.results.files import decode_mask
from tracking3d.results.records import FrameRecord
from tracking3d.results.refinement_writer import RefinementWriter, adjusted_record
from tracking3d.runtime.stage_times import measure


@dataclass(frozen=True, eq=False)
class PrecomputedRefinement:
    """What the last passes come to, found elsewhere: see `tracking3d.submaps.parallel_refinement`.

    Attributes:
        look: What all frames say together, settled.
        answers: Their answers, poses put right.
        masks: The masks that were decided anew, as PNG, by index; their probabilities are written.
    """

    look: GlobalAdjustment
    answers: Mapping[int, FrameRecord]
    masks: Mapping[int, bytes]


def adjust_pose(
    estimate: FrameRecord, look: GlobalAdjustment, image: Image, mask: NDArray[np.bool_]
) -> FrameRecord:
    """A frame's answer with the pose that all frames together say; a causal one as it is.

    Args:
        estimate: Of the frame.
        look: What all frames say together, settled.
        image: ``(H, W, 3)`` the frame.
        mask: ``(H, W)`` the answer's.
    """
    if not estimate.refined:
        return estimate
    T_cam_obj, support = look.pose(estimate, image, mask)
    judged = () if support is None else assess_estimate(estimate, support)
    return adjusted_record(estimate, T_cam_obj, *judged)


class RefinementPass:
    """Puts right what a final refinement has answered, from all frames together.

    Args:
        refinement: Its answers.
        model: The object as it has made it.
        camera: Of the full frame.
        most: How many frames are bundled.
        weighs_masks: Whether masks are weighed once more; the frames then come once more for it, see `put_right`.
        fixed: Indices of frames whose masks the user has given.
        foreseen: What comes of it, where that is known; then frames are only drawn.
    """

    def __init__(
        self,
        refinement: RefinementWriter,
        model: ObjectModel,
        camera: Camera,
        most: int,
        weighs_masks: bool,
        fixed: Collection[int],
        foreseen: PrecomputedRefinement | None = None,
    ) -> None:
        self._refinement, self._fixed, self._foreseen = refinement, fixed, foreseen
        self.weighs_masks = weighs_masks and foreseen is None
        self._faces = np.asarray(model.faces, np.int64)
        self._look = (
            foreseen.look if foreseen else GlobalAdjustment(model, camera, sorted(refinement.causal), most)
        )
        self._masks: MaskRefinement | None = None

    def see(self, estimate: FrameRecord, image: Image, mask: NDArray[np.bool_]) -> None:
        """A frame that was looked at again, with the mask ``(H, W)`` of its answer."""
        if estimate.refined and self._foreseen is None:
            self._look.see(estimate, image, mask)

    def settle(self) -> Camera:
        """All were: put together what they say; the camera of the end."""
        if self._foreseen is not None:
            return self._look.camera
        with measure("map") as watch:
            self._look.settle()
        self._refinement.together += watch.times
        if self.weighs_masks:
            estimates = [self._refinement.answer(index) for index in self._refinement.causal]
            self._masks = MaskRefinement(
                self._look.camera, self._look.vertices_of_landmarks, self._faces, estimates
            )
        return self._look.camera

    def put_right(self, frame: Frame) -> None:
        """Give a frame the pose that all frames together say, before masks are weighed."""
        if self._masks is not None and frame.index in self._refinement.causal:
            mask = self._place(frame)
            if self._masks.wants(frame.index):
                self._masks.see(self._masked(frame, mask))

    def draw(self, frame: Frame, do: Callable[[Callable[[], None]], object]) -> None:
        """Draw a frame as it is answered in the end; where masks are weighed some frames late, with those around it.

        Args:
            frame: The frame.
            do: Does what writes.
        """
        if frame.index not in self._refinement.causal:
            return
        if self._foreseen is not None:
            self._draw_foreseen(self._foreseen, frame, do)
        elif self._masks is not None:
            mask = self._refinement.mask(self._refinement.answer(frame.index))
            self._draw(self._masks.decide(self._masked(frame, mask)), do)
        else:
            mask, initial = self._place(frame), self._refinement.initial_mask(frame.index)
            do(partial(self._refinement.draw, frame, mask, initial))

    def rest(self, do: Callable[[Callable[[], None]], object]) -> None:
        """Draw the frames that are left when there are no more to come; ``do`` as in `draw`."""
        if self._masks is not None:
            self._draw(self._masks.rest(), do)

    def moved(
        self, model: ObjectModel, views: Collection[TextureView]
    ) -> tuple[ObjectModel, tuple[TextureView, ...]]:
        """The model with the surface that was found, and what its texture is taken from with the poses of the end."""
        answered = ((view, self._refinement.answer(view.index)) for view in views)
        return self._look.moved(model), tuple(
            self._look.seen_by(view, estimate) for view, estimate in answered
        )

    def _place(self, frame: Frame) -> NDArray[np.bool_]:
        """Put a frame's pose right; its mask ``(H, W)``."""
        estimate = self._refinement.answer(frame.index)
        mask = self._refinement.mask(estimate)
        self._refinement.put(adjust_pose(estimate, self._look, frame.image, mask))
        return mask

    def _draw_foreseen(
        self, foreseen: PrecomputedRefinement, frame: Frame, do: Callable[[Callable[[], None]], object]
    ) -> None:
        index, initial = frame.index, self._refinement.initial_mask(frame.index)
        if (estimate := foreseen.answers.get(index)) is not None:
            self._refinement.put(estimate)
        mask = None if (decided := foreseen.masks.get(index)) is None else decode_mask(decided)
        if mask is None:
            mask = self._refinement.mask(self._refinement.answer(index))
        else:
            self._refinement.put_mask(index, mask, None, initial)
        do(partial(self._refinement.draw, frame, mask, initial))

    def _masked(self, frame: Frame, mask: NDArray[np.bool_]) -> Masked:
        estimate, initial = self._refinement.answer(frame.index), self._refinement.initial_mask(frame.index)
        return Masked(frame, estimate, initial, mask, frame.index in self._fixed)

    def _draw(self, decisions: Iterator[Decision], do: Callable[[Callable[[], None]], object]) -> None:
        with measure("map") as watch:
            for masked, decided in decisions:
                frame, mask = masked.frame, masked.mask
                if decided is not None:
                    mask = decided.mask
                    self._refinement.put_mask(frame.index, mask, decided.probability, masked.initial)
                do(partial(self._refinement.draw, frame, mask, masked.initial))
        self._refinement.together += watch.times
