"""How far given masks are kept because they agree with each other.

Exact masks are silhouettes of one object: their visual hull, rendered in each frame, has their outlines, also where the
surface cannot follow the object. Something in front of the object takes a part from a mask, and leaves the rest of its
outline alone. Masks that take in background reach beyond the hull, in another place in each frame, and outlines that
are drawn roughly lie on it nowhere. This is asked of masks that the user gives: those of a mask tracker may be wrong in
the same way in all frames, as on a bowl that turns about its axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.colour_models import near_outlines, relative_distance
from tracking3d.estimation.segmentation.soft_visual_hull import SoftVisualHull
from tracking3d.scene.surface import Drawn

_FADING = 0.15
"""Weight that an initial mask lacks, up to which its outline is smoothed in proportion; chosen. At full weight it is
kept as it is. Processors differ by .036 in the weight of a run."""
_MOST_FRAMES = 24
"""Frames in which the hull is compared, spread over those that it was made from."""
_BEYOND, _APART = (0.008, 0.013), (0.016, 0.022)
"""How far masks reach beyond the hull, in the mean along their outlines, and the median distance of both outlines,
relative to the root of the area: up to the first value of each masks agree fully, from the second not at all. Exact
masks of real videos reach .002 to .006 beyond and are .004 to .015 apart, those of csrt .005 to .018 and .007 to .020;
the exact ones of a mug that a hand hides in part .005 and .012."""
_BEYOND_IN_FRAME, _APART_IN_FRAME = (0.012, 0.025), (0.035, 0.06)
"""The same in a single frame: from the second values on its mask has nothing in common with the others."""


class InitialMaskAgreement:
    """Collects frames, then gives the weight of their initial masks.

    Args:
        vertices: ``(V, 3)`` of the object: where the hull can be.
        slack: By how much more masks may differ than with refined poses; causal ones are less exact.

    Attributes:
        weight: In [0, 1]; 0 before `settle`.
    """

    def __init__(self, vertices: NDArray[np.float64], slack: float = 1.0) -> None:
        self._hull, self._slack = SoftVisualHull(vertices), slack
        self._scenes: list[Drawn] = []
        self.weight = 0.0

    def see(self, scene: Drawn) -> None:
        """Add a frame whose pose is reliable."""
        if scene.initial.any():
            self._hull.see(replace(scene, mask=scene.initial))
            self._scenes.append(replace(scene, image=np.zeros((0, 0, 3), np.uint8)))

    def settle(self) -> None:
        """All frames are there: compute the weight."""
        self._hull.settle()
        count = len(self._scenes)
        places = np.linspace(0, count - 1, min(_MOST_FRAMES, count)).round().astype(int)
        differences = [self._difference(self._scenes[place]) for place in places]
        self._scenes = []
        known = [one for one in differences if one is not None]
        if known:
            beyond, apart = np.median(known, 0) / self._slack
            self.weight = _falling(beyond, _BEYOND) * _falling(apart, _APART)

    def of_frame(self, scene: Drawn) -> float:
        """The weight of a frame's initial mask, in [0, 1]: less if it has another outline than the others."""
        difference = self._difference(scene) if self.weight else None
        if difference is None:
            return 0.0
        beyond, apart = np.array(difference) / self._slack
        return self.weight * _falling(beyond, _BEYOND_IN_FRAME) * _falling(apart, _APART_IN_FRAME)

    def _difference(self, scene: Drawn) -> tuple[float, float] | None:
        """How far an initial mask reaches beyond the hull, and how far apart both outlines are; None without a hull."""
        drawn = self._hull.drawn(scene)
        if drawn is None:
            return None
        root = float(np.sqrt(np.count_nonzero(scene.initial)))
        mask, beyond, apart = relative_distance(scene.initial), 0.0, list[float]()
        for hull in drawn / root:
            band = near_outlines(mask, hull)
            if not band.any():
                return None
            difference = (mask - hull)[band]
            # The last hull is the wide one: a part that something hides in some frames stays in it.
            beyond = float(np.maximum(difference, 0).mean())
            # A side that few frames show has its outline in the narrow one only.
            apart.append(float(np.median(np.abs(difference))))
        return beyond, min(apart)


def smoothing_of(weight: float) -> float:
    """How far the outline of an initial mask of that weight is smoothed along the image's edges, in [0, 1]."""
    return min((1 - weight) / _FADING, 1.0)


def _falling(value: float, limits: tuple[float, float]) -> float:
    full, none = limits
    return float(np.clip((none - value) / (none - full), 0, 1))
