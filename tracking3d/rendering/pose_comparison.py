"""What poses of a frame are compared with, and what such a comparison yields: see `tracking3d.rendering.pose_terms`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.rendering.normal_equations import NormalEquations
from tracking3d.rendering.surface import Surface, check_shapes

NEAREST_POINT = 1e-3
"""Matched points at a smaller depth are seen as if they were there."""


@dataclass(frozen=True, eq=False)
class PoseTarget:
    """What a frame shows in a window of ``S`` x ``S`` pixels."""

    K: Tensor  # (3, 3) intrinsics of the window
    features: Tensor  # (C, S, S)
    comparable: Tensor  # (S, S) how much each pixel's features count, in [0, 1]
    inside: Tensor  # (S, S) bool, inside the frame
    mask: Tensor | None  # (S, S) bool; None if there is none
    distance: Tensor | None  # (S, S) signed distance in pixels to the mask's outline; None without a mask

    def overlap(self, covered: Tensor) -> Tensor:
        """IoU of covered pixels ``(..., S, S)`` with the mask, inside the frame; 1 without a mask."""
        if self.mask is None:
            return torch.ones(covered.shape[:-2], dtype=torch.float64)
        covered, mask = covered & self.inside, self.mask & self.inside
        either = (covered | mask).sum((-2, -1)).clamp_min(1)
        return ((covered & mask).sum((-2, -1)).double() / either).cpu()


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Surface points and where a frame shows them."""

    points: Tensor  # (N, 3) in object coordinates
    pixels: Tensor  # (N, 2) in the frame's window

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Scales:
    """Where the terms' Cauchy losses are ``log 2``: differences of features, pixels, pixels."""

    appearance: float
    outline: float
    points: float


@dataclass(frozen=True, eq=False)
class PoseTerms:
    """The terms of B poses, float64 on the CPU; a term of which a frame says nothing is zero."""

    # term of the covered pixels, weighted by `PoseTarget.comparable` and how far their texture is seen
    appearance: NormalEquations
    outline: NormalEquations  # term of the silhouette's contour
    points: NormalEquations  # term of the matched points
    comparable: Tensor  # (B,) sum of `PoseTarget.comparable` over the covered pixels
    known: Tensor  # (B,) the same of those whose texture is seen
    overlap: Tensor  # (B,) IoU of what is covered with the mask, inside the frame; 1 without a mask


def check_comparison(surface: Surface, target: PoseTarget, matched: MatchedPoints | None) -> None:
    """Make sure that everything has the shape it is said to have.

    Raises:
        ValueError: If a shape does not fit.
    """
    check_shapes(
        K=(target.K, "3 3"),
        texture=(surface.texture, "C T T"),
        features=(target.features, "C S S"),
        comparable=(target.comparable, "S S"),
        inside=(target.inside, "S S"),
        mask=(target.inside if target.mask is None else target.mask, "S S"),
        distance=(target.comparable if target.distance is None else target.distance, "S S"),
    )
    if matched is not None:
        check_shapes(points=(matched.points, "N 3"), pixels=(matched.pixels, "N 2"))
