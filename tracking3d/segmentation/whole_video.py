"""Segments every frame again once the whole video is known: what most frames label as object is object in all.

The frames are gone through twice. The first time, masks and poses that are trusted are put together: a hull of their
masks, and the colours of object and surroundings. The second time each pixel is weighed, with the frames around it in
time telling which motion it has.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d.runtime.concurrency import OrderedExecutor
from tracking3d.segmentation.colour_models import ColourModels, as_lab
from tracking3d.segmentation.frame_window import Answered, FrameWindow, Mask, Plane
from tracking3d.segmentation.initial_mask_agreement import InitialMaskAgreement, smoothing_of
from tracking3d.segmentation.mask_extraction import clean_mask, paste_window, snap_to_edges
from tracking3d.segmentation.motion_cue import motion_cue
from tracking3d.segmentation.pose_weight import blend_with_initial, pose_weight, shape_log_odds
from tracking3d.segmentation.soft_visual_hull import SoftVisualHull
from tracking3d.segmentation.temporal_neighbours import REACH, TemporalNeighbours
from tracking3d.segmentation.whole_video_features import PixelEvidence
from tracking3d.segmentation.whole_video_weights import WEIGHTS

_LEAST_CONFIDENCE = 0.5
"""Of the frames that are combined; all if none has it."""
MOST_VIEWS = 24
"""The most frames that are combined, spread over the reliable ones."""
_ASKED = 0.4
"""How far the image smooths what is said, see `snap_to_edges`: in an even one outlines would creep."""
_AT_A_TIME = 2
"""Frames that are decided at a time, in as many threads as OpenCV may take at most."""
_MOST_CHANGE = 0.35  # of the union of both masks; a mask that changes more is another object's


@dataclass(frozen=True, eq=False)
class SegmentedMask:
    """What came of a frame."""

    index: int  # the index of the frame
    mask: Mask  # (H, W)
    probability: Plane  # (H, W) of the object; the mask is where it is above a half
    is_initial: bool = False  # whether it is the initial mask as it was


class VideoSegmenter:
    """All frames of a video, with their masks and poses.

    Args:
        camera: The camera of the frames, without a lens.
        vertices: ``(V, 3)`` of the object.
        faces: ``(F, 3)``.
        confidences: Of the frames that have a pose, by index.
        due: Indices of the frames that are decided; all if None.
        has_given_masks: Whether the user gives the initial masks: they are kept if they agree with each other.
        may_keep: Indices of the frames that keep their mask if nothing contradicts it.
        agreement: IoU above which silhouette and initial mask do not.

    Attributes:
        order: The latest frames of the second time.
        kept: The frames that keep their mask.
    """

    def __init__(
        self,
        camera: Camera,
        vertices: NDArray[np.float64],
        faces: NDArray[np.int64],
        confidences: dict[int, float],
        due: Collection[int] | None = None,
        has_given_masks: bool = False,
        may_keep: Collection[int] = (),
        agreement: float = 1.0,
    ) -> None:
        self._may_keep, self._least_agreement = may_keep, agreement
        self.kept: set[int] = set()
        self._seen: list[int] = []
        self._camera, self._vertices, self._faces = camera, vertices, faces
        self._due, self._shown = due, frozenset[int]()
        chosen = sorted(index for index, confidence in confidences.items() if confidence >= _LEAST_CONFIDENCE)
        chosen = chosen or sorted(confidences)
        places = np.linspace(0, len(chosen) - 1, min(MOST_VIEWS, len(chosen))).round().astype(int)
        self._wanted = {chosen[place] for place in places}
        self._consensus = SoftVisualHull(vertices)
        self._agreement = InitialMaskAgreement(vertices) if has_given_masks else None
        self._colours: ColourModels | None = None
        self.order, self._waiting = TemporalNeighbours(), deque[Answered]()
        self._jobs: OrderedExecutor | None = None

    def see(self, frame: Answered) -> None:
        """A frame for the first time, in the order of time; some of them are put together."""
        self._seen.append(frame.index)
        wanted, may_keep = frame.index in self._wanted, frame.index in self._may_keep
        if not (wanted or may_keep) or not np.isfinite(frame.T_cam_obj).all():
            return
        scene = self._scene(frame)
        if scene is None or not scene.answer.any():
            return
        if may_keep and _least_iou(scene) > self._least_agreement:
            self.kept.add(frame.index)
        if wanted:
            self._consensus.see(scene)
            if self._agreement is not None:
                self._agreement.see(scene)
            self._colours = ColourModels.of(as_lab(scene.image), scene.answer, self._colours, scene.occluder)

    def settle(self) -> None:
        """All frames were seen a first time."""
        due = self._seen if self._due is None else self._due
        self._due = frozenset(due) - self.kept
        places = [place for place, index in enumerate(self._seen) if index in self._due]
        near = {place + step for place in places for step in range(-REACH, REACH + 1)}
        self._shown = frozenset(index for place, index in enumerate(self._seen) if place in near)
        self._consensus.settle()
        if self._agreement is not None:
            self._agreement.settle()

    def needs(self, index: int) -> bool:
        """Whether a frame is decided, or tells the motion around one that is; before any other comes `rest`."""
        return index in self._shown

    def decide(self, frame: Answered) -> Iterator[tuple[int, SegmentedMask | None]]:
        """A frame for the second time.

        Args:
            frame: The next one, in the order of time.

        Yields:
            Indices of earlier frames whose turn has come, with what is decided; None if the answer stands.
        """
        self.order.add(frame)
        self._waiting.append(frame)
        if len(self._waiting) > REACH:
            yield from self._begin(self._waiting.popleft())

    def rest(self) -> Iterator[tuple[int, SegmentedMask | None]]:
        """Those that are left when there are no more frames, or when some are passed over; see `decide`."""
        while self._waiting:
            yield from self._begin(self._waiting.popleft())
        if self._jobs is not None:
            yield from self._jobs.rest()
        self.order = TemporalNeighbours()

    def said(
        self, frame: Answered, order: TemporalNeighbours | None = None
    ) -> tuple[FrameWindow, PixelEvidence] | None:
        """What the sources say of one of the latest frames; None if it has no masks or no pose.

        Args:
            frame: The frame.
            order: Those around it; `order` as it is, if left out.
        """
        if not frame.initial.any() or not frame.answer.any() or not np.isfinite(frame.T_cam_obj).all():
            return None
        scene = self._scene(frame)
        if scene is None or not scene.initial.any() or not scene.answer.any():
            return None
        around = (order or self.order).around(frame.index, scene, self._camera)
        motion = motion_cue(scene, self._camera, around)
        return scene, PixelEvidence.of(scene, self._consensus.drawn(scene), self._colours, motion)

    def _scene(self, frame: Answered) -> FrameWindow | None:
        return FrameWindow.of(frame, self._camera, self._vertices, self._faces)

    def _begin(self, frame: Answered) -> Iterator[tuple[int, SegmentedMask | None]]:
        if self._jobs is None:  # as many threads as there are where frames are decided
            self._jobs = OrderedExecutor(min(cv2.getNumThreads(), _AT_A_TIME))
        yield from self._jobs.do(partial(self._decided, frame, self.order.as_it_is()))

    def _decided(self, frame: Answered, order: TemporalNeighbours) -> tuple[int, SegmentedMask | None]:
        if self._due is not None and frame.index not in self._due:
            return frame.index, None
        if not pose_weight(frame.confidence):
            return frame.index, None
        initial_weight = self._initial_weight(frame)
        if initial_weight == 1:
            return frame.index, SegmentedMask(
                frame.index, frame.initial, frame.initial.astype(np.float32), is_initial=True
            )
        asked = self.said(frame, order)
        if asked is None:
            return frame.index, None
        scene, said = asked
        weight = (1 - initial_weight) * pose_weight(frame.confidence)
        odds = said.log_odds(WEIGHTS)
        if scene.occluder is not None and (behind := said.shape) is not None:
            odds = np.where(scene.occluder, shape_log_odds(behind), odds)
        odds = blend_with_initial(odds, scene.initial, weight)
        support = clean_mask(snap_to_edges(scene.image, odds, smoothing_of(initial_weight) * _ASKED))
        support = np.where(scene.valid, support, -1).astype(np.float32)
        full = paste_window(support, scene.window, np.full(frame.answer.shape, -1, np.float32))
        mask = full > 0
        common, either = (
            np.count_nonzero(way(mask, frame.answer)) for way in (np.logical_and, np.logical_or)
        )
        if common < (1 - _MOST_CHANGE) * either:
            return frame.index, None
        return frame.index, SegmentedMask(frame.index, mask, 0.5 + 0.5 * full)

    def _initial_weight(self, frame: Answered) -> float:
        """The weight of an initial mask because it agrees with those of other frames; 0 if the user gave none."""
        if self._agreement is None or not frame.initial.any() or not np.isfinite(frame.T_cam_obj).all():
            return 0.0
        scene = self._scene(frame)
        return 0.0 if scene is None or not scene.initial.any() else self._agreement.of_frame(scene)


def _least_iou(scene: FrameWindow) -> float:
    """The lower IoU of a frame's mask with the silhouette and with the initial mask, where there is one."""
    others = [scene.drawn & scene.valid, *([scene.initial] if scene.initial.any() else [])]
    return min(
        np.count_nonzero(scene.answer & other) / np.count_nonzero(scene.answer | other) for other in others
    )


def segment_all(
    hindsight: VideoSegmenter, frames: Iterable[Answered]
) -> Iterator[tuple[int, SegmentedMask | None]]:
    """Every frame of a video whose frames were all seen once, in their order."""
    for frame in frames:
        yield from hindsight.decide(frame)
    yield from hindsight.rest()
