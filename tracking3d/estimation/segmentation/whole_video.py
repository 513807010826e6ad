"""Segments every frame again once the whole video is known: what most frames label as object is object in all.

The frames are gone through twice. The first time, masks and poses that are trusted are put together: a hull of their
masks, and the colours of object and surroundings. The second time each pixel is weighed, with the frames around it in
time telling which motion it has.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.colour_models import (
    ColourModels,
    beside_outline,
    outline_difference,
    relative_distance,
)
from tracking3d.estimation.segmentation.initial_mask_agreement import InitialMaskAgreement, smoothing_of
from tracking3d.estimation.segmentation.mask_extraction import clean_mask, paste_window, snap_to_edges
from tracking3d.estimation.segmentation.motion_cue import motion_cue
from tracking3d.estimation.segmentation.pose_weight import blend_with_initial, pose_weight, shape_log_odds
from tracking3d.estimation.segmentation.soft_visual_hull import SoftVisualHull
from tracking3d.estimation.segmentation.temporal_neighbours import REACH, TemporalNeighbours
from tracking3d.estimation.segmentation.whole_video_weights import WEIGHTS
from tracking3d.frames import mask_iou_or_none
from tracking3d.geometry.camera import Camera, Window
from tracking3d.runtime.concurrency import OrderedExecutor
from tracking3d.scene.surface import Drawn, draw
from tracking3d.scene.view import Mask, ObjectView, Plane
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.outline import inside_distance

LARGEST, LARGEST_AGAIN = 320, 256
"""Pixels of a window's side; a larger one is seen smaller. The second where the whole video is known and a pixel is not
more than two of the picture (measured: IoU of box_in_hand .946 with 320, .947 with 256; of temple_ring .929, .923)."""
_MARGIN = 0.2  # beside the masks, relative to their longer side
_LEAST_CONFIDENCE = 0.5
"""Of the frames that are combined; all if none has it."""
MOST_VIEWS = 48
"""The most frames that are combined, spread over the reliable ones."""
_ASKED = 0.4
"""How far the image smooths what is said, see `snap_to_edges`: in an even one outlines would creep."""
_AT_A_TIME = 2
"""Frames that are decided at a time, in as many threads as OpenCV may take at most."""
_MOST_EXAMPLES, _STAYS = 8, 0.97
"""So many masks that nothing contradicts are segmented first; three quarters of them have to stay with that IoU, if all
such are to be kept (measured: .989 and more on box_in_hand, .91 and .92 of half of them on temple_ring)."""
_MOST_CHANGE = 0.35  # of the union of both masks; a mask that changes more is another object's


def draw_around_masks(
    frame: ObjectView, vertices: NDArray[np.float64], faces: NDArray[np.int64], again: bool = False
) -> Drawn | None:
    """A whole frame seen through the window around its masks, with the surface in it; None if both are empty.

    Args:
        frame: The frame.
        vertices: ``(V, 3)`` of the object.
        faces: ``(F, 3)``.
        again: Whether the whole video is known, see `LARGEST_AGAIN`.
    """
    box = box_of(frame.initial | frame.mask)
    if box is None:
        return None
    window = Window.around(box, _MARGIN, LARGEST, enlarge=False)
    if again:
        window = replace(window, size=min(window.size, max(LARGEST_AGAIN, window.side // 2)))
    return draw(frame.at(window), vertices, faces)


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
        self._agreeing: set[int] = set()
        self._examples: list[Drawn] = []  # of them, to be segmented first
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
        self.order, self._waiting = TemporalNeighbours(), deque[ObjectView]()
        self._jobs: OrderedExecutor | None = None

    def see(self, frame: ObjectView) -> None:
        """A frame for the first time, in the order of time, drawn already or not; some of them are put together."""
        self._seen.append(frame.index)
        if not pose_weight(frame.confidence):  # such a pose redraws nothing
            self.kept.add(frame.index)
        wanted = frame.index in self._wanted
        may_keep = frame.index in self._may_keep and frame.index not in self.kept
        if not (wanted or may_keep) or not np.isfinite(frame.T_cam_obj).all():
            return
        scene = frame if isinstance(frame, Drawn) else self._scene(frame)
        if scene is None or not scene.mask.any():
            return
        if may_keep and _least_iou(scene) > self._least_agreement:
            self._agreeing.add(frame.index)
            if wanted:
                self._examples.append(scene)
        if wanted:
            self._consensus.see(scene)
            if self._agreement is not None:
                self._agreement.see(scene)
            self._colours = ColourModels.of(scene.lab, scene.mask, self._colours, scene.occluder)

    def settle(self) -> None:
        """All frames were seen a first time."""
        self._consensus.settle()
        if self._agreement is not None:
            self._agreement.settle()
        if self._examples_stay():
            self.kept |= self._agreeing
        self._examples = []
        due = self._seen if self._due is None else self._due
        self._due = frozenset(due) - self.kept
        places = [place for place, index in enumerate(self._seen) if index in self._due]
        near = {place + step for place in places for step in range(-REACH, REACH + 1)}
        self._shown = frozenset(index for place, index in enumerate(self._seen) if place in near)

    def _examples_stay(self) -> bool:
        """Whether masks that agree with silhouette and initial mask stay, as all frames together have them.

        All three may be wrong alike, as gaps between columns are that a mask tracker fills.
        """
        overlaps = list[float]()
        places = np.linspace(0, len(self._examples) - 1, min(_MOST_EXAMPLES, len(self._examples)))
        for scene in (self._examples[place] for place in places.round().astype(int)):
            motion = np.zeros((2, *scene.mask.shape), np.float32)
            said = PixelEvidence.of(scene, self._consensus.drawn(scene), self._colours, motion)
            overlaps.append(mask_iou_or_none(scene.mask, self._support(scene, said, 0.0) > 0) or 0.0)
        return not overlaps or float(np.quantile(overlaps, 0.25)) > _STAYS

    def needs(self, index: int) -> bool:
        """Whether a frame is decided, or tells the motion around one that is; before any other comes `rest`."""
        return index in self._shown

    def decide(self, frame: ObjectView) -> Iterator[tuple[int, SegmentedMask | None]]:
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
        self, frame: ObjectView, order: TemporalNeighbours | None = None
    ) -> tuple[Drawn, PixelEvidence] | None:
        """What the sources say of one of the latest frames; None if it has no masks or no pose.

        Args:
            frame: The frame.
            order: Those around it; `order` as it is, if left out.
        """
        if not frame.initial.any() or not frame.mask.any() or not np.isfinite(frame.T_cam_obj).all():
            return None
        scene = self._scene(frame)
        if scene is None or not scene.initial.any() or not scene.mask.any():
            return None
        around = (order or self.order).around(frame.index, scene, self._camera)
        motion = motion_cue(scene, self._camera, around)
        return scene, PixelEvidence.of(scene, self._consensus.drawn(scene), self._colours, motion)

    def _scene(self, frame: ObjectView) -> Drawn | None:
        return draw_around_masks(frame, self._vertices, self._faces, again=True)

    def _begin(self, frame: ObjectView) -> Iterator[tuple[int, SegmentedMask | None]]:
        if self._jobs is None:  # as many threads as there are where frames are decided
            self._jobs = OrderedExecutor(min(cv2.getNumThreads(), _AT_A_TIME))
        yield from self._jobs.do(partial(self._decided, frame, self.order.as_it_is()))

    def _decided(self, frame: ObjectView, order: TemporalNeighbours) -> tuple[int, SegmentedMask | None]:
        if self._due is not None and frame.index not in self._due:
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
        support = self._support(scene, said, initial_weight)
        full = paste_window(support, scene.window, np.full(frame.frame_size, -1, np.float32))
        mask = full > 0
        if (mask_iou_or_none(mask, frame.mask) or 0.0) < 1 - _MOST_CHANGE:
            return frame.index, None
        return frame.index, SegmentedMask(frame.index, mask, 0.5 + 0.5 * full)

    def _support(self, scene: Drawn, said: PixelEvidence, initial_weight: float) -> Plane:
        """``(S, S)`` in [-1, 1], positive where the object is."""
        weight = (1 - initial_weight) * pose_weight(scene.confidence)
        odds = said.log_odds(WEIGHTS)
        if scene.occluder is not None and (behind := said.shape) is not None:
            odds = np.where(scene.occluder, shape_log_odds(behind), odds)
        odds = blend_with_initial(odds, scene.initial, weight)
        support = clean_mask(snap_to_edges(scene.image, odds, smoothing_of(initial_weight) * _ASKED))
        return np.where(scene.in_frame, support, -1).astype(np.float32)

    def _initial_weight(self, frame: ObjectView) -> float:
        """The weight of an initial mask because it agrees with those of other frames; 0 if the user gave none."""
        if self._agreement is None or not frame.initial.any() or not np.isfinite(frame.T_cam_obj).all():
            return 0.0
        scene = self._scene(frame)
        return 0.0 if scene is None or not scene.initial.any() else self._agreement.of_frame(scene)


def _least_iou(scene: Drawn) -> float:
    """The lower IoU of a frame's mask with the silhouette and with the initial mask, where there is one."""
    others = [scene.silhouette, *([scene.initial] if scene.initial.any() else [])]
    return min(mask_iou_or_none(scene.mask, other) or 0.0 for other in others)


_ON, _OFF = 1.0, (3.0, 9.0)
"""Pixels from the outline within which an edge is on it, and between which it is beside it."""
_NEIGHBOURHOOD = 0.15  # half its side, relative to the root of the area
_MOST = 1.5


def edge_strength(lab: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``(S, S)`` how much the colours of a crop ``(S, S, 3)`` in 8-bit Lab change at each pixel, as a root."""
    smooth = cv2.GaussianBlur(lab, (0, 0), 0.8).astype(np.float32)
    total = np.zeros(lab.shape[:2], np.float32)
    for channel in range(3):
        plane = np.ascontiguousarray(smooth[..., channel])
        total += cv2.Sobel(plane, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(plane, cv2.CV_32F, 0, 1) ** 2
    strength = np.sqrt(total)
    return np.asarray(np.sqrt(strength / max(float(strength.mean()), 1e-6)), np.float32)


def alignment(edges: NDArray[np.float32], distance: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Log of how strong edges are on an outline over how strong they are beside it.

    Args:
        edges: ``(S, S)`` from `edge_strength`.
        distance: ``(S, S)`` pixels to the outline, positive inside.

    Returns:
        ``(S, S)`` around each pixel, within 1.5, and of the whole outline; 0 if there is no outline.
    """
    area = int(np.count_nonzero(distance > 0))
    if area in (0, distance.size):
        return np.zeros_like(distance), 0.0
    distance = np.abs(distance)
    on, off = (
        (distance <= _ON).astype(np.float32),
        ((distance >= _OFF[0]) & (distance <= _OFF[1])).astype(np.float32),
    )
    side = (2 * max(round(_NEIGHBOURHOOD * math.sqrt(area)), 2) + 1,) * 2
    floor = 0.05
    sums = [cv2.blur(plane, side) for plane in (edges * on, on, edges * off, off)]
    tiny = 1e-4
    known = np.minimum(sums[1] / 0.01, 1.0)
    local = known * np.log((sums[0] / (sums[1] + tiny) + floor) / (sums[2] / (sums[3] + tiny) + floor))
    whole = math.log(
        (float((edges * on).sum()) / max(float(on.sum()), 1) + floor)
        / (float((edges * off).sum()) / max(float(off.sum()), 1) + floor)
    )
    return np.clip(local, -_MOST, _MOST).astype(np.float32), whole


# The features of each pixel once all frames are known: shapes, colours, motion, and how far each can be trusted.
#
# Every source is odd: without it, or where it cannot tell, it is 0, and what speaks for the object is positive. There
# is no constant, which would say that masks are too large or too small as those of some tracker are.

_DEEP, _NEAR, _AT_OUTLINE, _MOST_LOG_ODDS = 0.25, 0.08, 0.02, 1.5
_BESIDE = 0.15
_APART = 0.03
_SCALE_OF_LOGS, _SCALE_OF_MOTION = 3.0, 2.0


@dataclass(frozen=True, eq=False)
class PixelEvidence:
    """What the sources say in one frame."""

    # (S, S) signed distances, positive inside, over the root of the area, by whose outline it is: initial,
    # answer, drawn and the hulls hull and wide hull; absent if there is none
    distances: Mapping[str, Plane]
    # how well each lies on edges, around each pixel (S, S) and on the whole
    alignments: Mapping[str, tuple[Plane, float]]
    colours: Plane  # (2, S, S) beside the outline, and remembered
    motion: Plane  # (2, S, S)
    confidence: float  # the confidence of the pose

    @classmethod
    def of(
        cls, scene: Drawn, hulls: Plane | None, colours: ColourModels | None, motion: Plane
    ) -> PixelEvidence:
        """Ask all of them.

        Args:
            scene: The frame.
            hulls: ``(2, S, S)`` from `soft_visual_hull.SoftVisualHull.drawn`, or None.
            colours: What all frames that are trusted show, or None.
            motion: From `motion_cue.motion_cue`.
        """
        lab = scene.lab
        masks = {"initial": scene.initial, "answer": scene.mask}
        masks |= {"drawn": scene.silhouette} if scene.silhouette.any() else {}
        outlines = {name: inside_distance(mask) for name, mask in masks.items()}
        distances = {name: relative_distance(mask, outlines[name]) for name, mask in masks.items()}
        if hulls is not None:
            root = math.sqrt(max(int(np.count_nonzero(scene.mask)), 1))
            named = dict(zip(("hull", "wide hull"), hulls, strict=True))
            distances |= {name: hull / root for name, hull in named.items()}
            outlines |= {name: inside_distance(hull > 0) for name, hull in named.items()}
        edges = edge_strength(lab)
        alignments = {name: alignment(edges, outline) for name, outline in outlines.items()}
        nearby = beside_outline(lab, scene.mask) if scene.mask.any() else np.zeros_like(edges)
        remembered = np.zeros_like(edges) if colours is None else colours.log_ratio(lab)
        return cls(distances, alignments, np.stack([nearby, remembered]), motion, scene.confidence)

    @property
    def in_reach(self) -> NDArray[np.bool_]:
        """``(S, S)``: what may be the object's."""
        masks = [self.distances[name] for name in ("initial", "answer", "drawn") if name in self.distances]
        return np.asarray(np.max(masks, 0) > -_BESIDE)

    @property
    def shape(self) -> Plane | None:
        """``(S, S)`` distance to the outline of what surface and hull both contain; None if there are not both.

        The hull has what enough frames show: a part that something hides in all of them is not made up.
        """
        if not {"drawn", "wide hull"} <= self.distances.keys():
            return None
        return np.minimum(self.distances["drawn"], self.distances["wide hull"])

    def sources(self) -> Iterator[tuple[str, Plane]]:
        """Each by name, ``(S, S)``."""
        for plane, beliefs in self._terms():
            yield from ((name, plane * belief) for name, belief in beliefs.items())

    def log_odds(self, weights: Mapping[str, float]) -> Plane:
        """``(S, S)`` log-odds of the object."""
        total = np.zeros_like(self.colours[0])
        for plane, beliefs in self._terms():
            factors = [np.float32(weights[name]) * belief for name, belief in beliefs.items()]
            total += sum(factors[1:], factors[0]) * plane
        return np.where(self.in_reach, total, -6.0).astype(np.float32)

    def _terms(self) -> Iterator[tuple[Plane, dict[str, np.float32 | Plane]]]:
        """What is said, ``(S, S)``, and by source how far it is trusted: throughout, or ``(S, S)`` of each pixel."""
        one, confidence, doubt = np.float32(1), np.float32(self.confidence), np.float32(self._doubt())
        for name, distance in self.distances.items():
            around, whole = self.alignments[name]
            beliefs: dict[str, np.float32 | Plane] = {
                "": one,
                " on edges": np.clip(around, -1, 1),
                " on edges as a whole": np.float32(np.clip(whole, -0.5, 1.5)),
            }
            beliefs |= {" by doubt": doubt} if name == "initial" else {" by confidence": confidence}
            near, at = (
                np.clip(distance / _NEAR, -_MOST_LOG_ODDS, _MOST_LOG_ODDS),
                np.tanh(distance / _AT_OUTLINE),
            )
            yield near, {f"{name}, near{how}": belief for how, belief in beliefs.items()}
            yield at, {f"{name}, at the outline{how}": belief for how, belief in beliefs.items()}
            if name != "wide hull":
                yield np.clip(distance / _DEEP, -_MOST_LOG_ODDS, _MOST_LOG_ODDS), {f"{name}, deep": one}
        edges = np.float32(np.clip(self.alignments["initial"][1], -0.5, 1.5))
        names = "colours beside the outline", "colours remembered"
        for name, plane in zip(names, self.colours / _SCALE_OF_LOGS, strict=True):
            yield plane, {name: one, f"{name} by doubt": doubt, f"{name} by the initial mask's edges": edges}
        names = "motion of colours", "motion of fine texture"
        for name, plane in zip(names, self.motion / _SCALE_OF_MOTION, strict=True):
            yield plane, {name: one, f"{name} by doubt": doubt}

    def _doubt(self) -> float:
        """How far the initial mask's outline is from the drawn surface's, in [0, 2]."""
        drawn = self.distances.get("drawn")
        if drawn is None:
            return 2.0
        difference = outline_difference(self.distances["initial"], drawn)
        return 2.0 if difference is None else min(difference / _APART, 2.0)
