"""The features of each pixel once all frames are known: shapes, colours, motion, and how far each can be trusted.

Every source is odd: without it, or where it cannot tell, it is 0, and what speaks for the object is positive. There is
no constant, which would say that masks are too large or too small as those of some tracker are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.segmentation.colour_models import (
    ColourModels,
    as_lab,
    beside_outline,
    outline_difference,
    relative_distance,
)
from tracking3d.segmentation.edge_alignment import alignment, edge_strength
from tracking3d.segmentation.frame_window import FrameWindow
from tracking3d.trackers.outline import inside_distance

Plane = NDArray[np.float32]

_DEEP, _NEAR, _AT_OUTLINE, _MOST = 0.25, 0.08, 0.02, 1.5
_BESIDE = 0.15
"""Nothing further outside all masks, relative to the root of the area, is the object's."""
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
        cls, scene: FrameWindow, hulls: Plane | None, colours: ColourModels | None, motion: Plane
    ) -> PixelEvidence:
        """Ask all of them.

        Args:
            scene: The frame.
            hulls: ``(2, S, S)`` from `tracking3d.segmentation.soft_visual_hull.SoftVisualHull.drawn`, or None.
            colours: What all frames that are trusted show, or None.
            motion: From `tracking3d.segmentation.motion_cue.motion_cue`.
        """
        lab = as_lab(scene.image)
        masks = {"initial": scene.initial, "answer": scene.answer}
        masks |= {"drawn": scene.drawn} if scene.drawn.any() else {}
        outlines = {name: inside_distance(mask) for name, mask in masks.items()}
        distances = {name: relative_distance(mask, outlines[name]) for name, mask in masks.items()}
        if hulls is not None:
            root = math.sqrt(max(int(np.count_nonzero(scene.answer)), 1))
            named = dict(zip(("hull", "wide hull"), hulls, strict=True))
            distances |= {name: hull / root for name, hull in named.items()}
            outlines |= {name: inside_distance(hull > 0) for name, hull in named.items()}
        edges = edge_strength(lab)
        alignments = {name: alignment(edges, outline) for name, outline in outlines.items()}
        nearby = beside_outline(lab, scene.answer) if scene.answer.any() else np.zeros_like(edges)
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
            near, at = np.clip(distance / _NEAR, -_MOST, _MOST), np.tanh(distance / _AT_OUTLINE)
            yield near, {f"{name}, near{how}": belief for how, belief in beliefs.items()}
            yield at, {f"{name}, at the outline{how}": belief for how, belief in beliefs.items()}
            if name != "wide hull":
                yield np.clip(distance / _DEEP, -_MOST, _MOST), {f"{name}, deep": one}
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
