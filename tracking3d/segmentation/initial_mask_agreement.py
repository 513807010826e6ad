"""How far given masks are kept because they agree with each other.

Exact masks are silhouettes of one object: their visual hull, rendered in each frame, has their outlines, also where the
surface cannot follow the object. Masks that miss parts or take in background differ from frame to frame, and their hull
has the outline of few of them. This is asked of masks that the user gives: those of a mask tracker may be wrong in the
same way in all frames, as on a bowl that turns about its axis.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tracking3d.segmentation.colour_models import outline_difference, relative_distance
from tracking3d.segmentation.frame_window import FrameWindow
from tracking3d.segmentation.soft_visual_hull import SoftVisualHull

KEEP_WEIGHT = 0.9
"""Weight from which an initial mask is kept as it is."""
_MOST_FRAMES = 24
"""Frames in which the hull is compared, spread over those that it was made from."""
_AGREE, _DIFFER = 0.018, 0.026
"""Median difference of the outlines of masks and hull, relative to the root of the area: up to the first masks agree
fully, from the second not at all. Exact masks of real videos have .005 to .016, those of csrt .012 to .051."""
_ANOTHER = 0.03, 0.05
"""The difference of a single mask: up to the first it is like the others, from the second it has nothing in common."""


@dataclass(eq=False)
class InitialMaskAgreement:
    """Collects frames, then gives the weight of their initial masks.

    Args:
        hull: An empty one of the object's surface.
        slack: By how much more masks may differ than with refined poses; causal ones are less exact.

    Attributes:
        weight: In [0, 1]; 0 before `settle`.
    """

    hull: SoftVisualHull
    slack: float = 1.0
    weight: float = field(default=0.0, init=False)
    _scenes: list[FrameWindow] = field(default_factory=list, init=False)

    def see(self, scene: FrameWindow) -> None:
        """Add a frame whose pose is reliable."""
        if scene.initial.any():
            self.hull.see(replace(scene, answer=scene.initial))
            self._scenes.append(replace(scene, image=np.zeros((0, 0, 3), np.uint8)))

    def settle(self) -> None:
        """All frames are there: compute the weight."""
        self.hull.settle()
        places = (
            np.linspace(0, len(self._scenes) - 1, min(_MOST_FRAMES, len(self._scenes))).round().astype(int)
        )
        differences = [self._difference(self._scenes[place]) for place in places]
        self._scenes = []
        known = [one for one in differences if one is not None]
        if known:
            self.weight = _falling(float(np.median(known)) / self.slack, _AGREE, _DIFFER)

    def of_frame(self, scene: FrameWindow) -> float:
        """The weight of a frame's initial mask, in [0, 1]: less if it has another outline than the others."""
        difference = self._difference(scene) if self.weight else None
        return 0.0 if difference is None else self.weight * _falling(difference / self.slack, *_ANOTHER)

    def _difference(self, scene: FrameWindow) -> float | None:
        """Of an initial mask's outline from that of the hull; None if there is no hull."""
        drawn = self.hull.drawn(scene)
        if drawn is None:
            return None
        root = float(np.sqrt(np.count_nonzero(scene.initial)))
        # The rank at which the fewest views carve: a single mask that misses a part takes it from all frames.
        return outline_difference(relative_distance(scene.initial), drawn[0] / root)


def _falling(value: float, full: float, none: float) -> float:
    return float(np.clip((none - value) / (none - full), 0, 1))
