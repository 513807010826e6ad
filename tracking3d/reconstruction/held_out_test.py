"""Whether a new shape explains frames better that were kept out of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.reconstruction.photometric_poses import coloured_surface, refine_views
from tracking3d.rendering import render
from tracking3d.scene.surface import camera_tensors
from tracking3d.scene.view import ObjectView

EVERY = 8
"""One in this many reliable frames is kept out of the reconstruction."""
_WORSE_OUTLINE = 0.01
"""IoU that may be lost if colours gain."""


MOST_LEFT_OUT = 32
"""Frames that are asked."""


def is_held_out(place: int) -> bool:
    """Whether a reliable frame, counted from 0, is kept out of the reconstruction."""
    return place % EVERY == EVERY // 2


@dataclass(frozen=True)
class HeldOutScore:
    """How well a shape explains frames, in the mean."""

    iou: float  # IoU of silhouette and mask
    # mean difference of colours in [0, 1] where both the mask and the surface are; what the surface does not
    # cover counts in the IoU
    colour: float

    def better_than(self, other: HeldOutScore) -> bool:
        """Whether it gains more than it loses, and no outline to speak of."""
        gain = self.iou - other.iou + other.colour - self.colour
        return gain > 0 and self.iou >= other.iou - _WORSE_OUTLINE


def score_held_out(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    views: Sequence[ObjectView],
    left_out: Sequence[ObjectView],
) -> HeldOutScore:
    """How well a shape, coloured by ``views``, explains those left out, whose poses alone are fitted to it.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        views: The frames that the shape was made from.
        left_out: The others.
    """
    surface = coloured_surface(vertices, faces, views)
    overlaps, differences = [], []
    for view in refine_views(surface, left_out):
        drawn = render(
            surface.vertices, surface.faces, surface.face_uvs, surface.texture,
            *camera_tensors(view), view.window.shape,
        )  # fmt: skip
        covered, mask = drawn.face_index[0].numpy() >= 0, view.mask
        either = (covered | mask) & view.in_frame
        overlaps.append((covered & mask).sum() / max(either.sum(), 1))
        colours = drawn.image()[0].permute(1, 2, 0).numpy()
        apart = np.abs(colours - view.image / 255.0).mean(2)
        both = covered & mask
        differences.append(float(apart[both].mean()) if both.any() else 1.0)
    return HeldOutScore(float(np.mean(overlaps)), float(np.mean(differences)))
