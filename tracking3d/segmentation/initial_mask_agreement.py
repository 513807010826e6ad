"""How far initial masks stand because they agree with each other better than the surface agrees with them.

Exact masks are silhouettes of one object: their visual hull, rendered in each frame, has their outlines, also where the
surface cannot follow the object. Masks that miss parts or take in background differ from frame to frame, and their hull
has the outline of few of them. Without turning every sequence of equal masks has such a hull, and it says nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.segmentation.colour_models import outline_difference, relative_distance
from tracking3d.segmentation.frame_window import FrameWindow
from tracking3d.segmentation.soft_visual_hull import SoftVisualHull

STANDS = 0.9
"""Weight from which an initial mask stands as it is."""
_MOST_FRAMES = 24
"""Frames in which the hull is compared, spread over those that it was made from."""
_AGREE, _DIFFER = 0.018, 0.026
"""Median difference of the outlines of masks and hull, relative to the root of the area: up to the first masks agree
fully, from the second not at all. Exact masks of real videos have .005 to .016, those of csrt .029 to .051."""
_ANOTHER = 0.03, 0.05
"""The difference of a single mask: up to the first it is like the others, from the second it has nothing in common."""
_SURFACE_WORSE, _SURFACE_EQUAL = 0.45, 0.6
"""The same difference relative to that of masks and surface. A mask tracker may be wrong in the same way in all frames,
as on a bottle that turns about its axis; the surface is overruled only where it fits much worse than the hull."""
_LITTLE_TURN, _ENOUGH_TURN = 10.0, 25.0
"""Median angle between two of the frames, degrees."""


@dataclass(eq=False)
class InitialMaskAgreement:
    """Collects frames, then gives the weight of their initial masks.

    Args:
        hull: An empty one of the object's surface.
    """

    hull: SoftVisualHull
    weight: float = field(default=0.0, init=False)
    _scenes: list[FrameWindow] = field(default_factory=list, init=False)

    def see(self, scene: FrameWindow) -> None:
        """Add a frame whose pose is reliable."""
        if scene.initial.any():
            self.hull.see(replace(scene, answer=scene.initial))
            self._scenes.append(replace(scene, image=np.zeros((0, 0, 3), np.uint8)))

    def settle(self) -> None:
        """All frames are there: compute the weight, in [0, 1]."""
        self.hull.settle()
        places = (
            np.linspace(0, len(self._scenes) - 1, min(_MOST_FRAMES, len(self._scenes))).round().astype(int)
        )
        scenes, self._scenes = [self._scenes[place] for place in places], []
        differences = [found for scene in scenes if (found := self._differences(scene)) is not None]
        if not differences:
            return
        to_hull, to_surface = np.median(differences, 0)
        turn = _median_turn(np.stack([scene.T_cam_obj[:3, :3] for scene in scenes]))
        equal = _share(to_hull / max(to_surface, 1e-6), _SURFACE_WORSE, _SURFACE_EQUAL)
        self.weight = (
            (1 - _share(to_hull, _AGREE, _DIFFER)) * (1 - equal) * _share(turn, _LITTLE_TURN, _ENOUGH_TURN)
        )

    def of_frame(self, scene: FrameWindow) -> float:
        """The weight of a frame's initial mask, in [0, 1]: less if it has another outline than the others."""
        if not self.weight:
            return 0.0
        differences = self._differences(scene)
        return 0.0 if differences is None else self.weight * (1 - _share(differences[0], *_ANOTHER))

    def _differences(self, scene: FrameWindow) -> tuple[float, float] | None:
        """Of an initial mask's outline from that of the hull and that of the surface; None without one of them."""
        drawn = self.hull.drawn(scene)
        if drawn is None or not scene.drawn.any():
            return None
        root = float(np.sqrt(np.count_nonzero(scene.initial)))
        mask = relative_distance(scene.initial)
        # The rank at which the fewest views carve: a single mask that misses a part takes it from all frames.
        to_hull = outline_difference(mask, drawn[0] / root)
        to_surface = outline_difference(mask, relative_distance(scene.drawn))
        return None if to_hull is None or to_surface is None else (to_hull, to_surface)


def _share(value: float, none: float, full: float) -> float:
    return float(np.clip((value - none) / (full - none), 0, 1))


def _median_turn(R: NDArray[np.float64]) -> float:
    """Degrees between two of the rotations ``(N, 3, 3)``."""
    if len(R) < 2:
        return 0.0
    traces = np.einsum("aij,bij->ab", R, R)[np.triu_indices(len(R), 1)]
    return float(np.median(np.degrees(np.arccos(np.clip((traces - 1) / 2, -1, 1)))))
