"""Colour models of object and background: from earlier frames, and from both sides of an outline."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.trackers.colour_models import Palette, histograms, log_ratio
from tracking3d.trackers.outline import inside_distance

_RATE = 0.1
_BAND = 0.04
"""Of the root of the area: outlines are compared as near to either of them."""
_INSIDE, _BESIDE = 0.03, (0.06, 0.4)
"""Distances from an outline, relative to the root of the area, from and within which a pixel surely is on its side."""
_NEIGHBOURHOOD = 0.4
"""Half the side of the neighbourhood in which colours are compared, relative to the root of the area."""
_RARE, _MOST = 0.002, 3.0
"""Share that is added to either side's, and limit of the log of their ratio."""

_PALETTE, _FEWER = (44, 40), (32, 24)
"""Pixels along either side of a crop from which its few colours are taken, and how many; the second while frames come,
where masks are as good with fewer (measured)."""


@dataclass(frozen=True, eq=False)
class ColourModels:
    """What earlier frames showed."""

    # (2, B) of the object and of its surroundings, see `tracking3d.trackers.colour_models`
    histograms: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        lab: NDArray[np.uint8],
        mask: NDArray[np.bool_],
        before: Self | None = None,
        occluder: NDArray[np.bool_] | None = None,
    ) -> Self | None:
        """What is known after one more frame.

        Args:
            lab: ``(S, S, 3)`` crop in 8-bit Lab.
            mask: ``(S, S)`` the object in it.
            before: What was known before.
            occluder: ``(S, S)`` what is in front of the object, and shows neither it nor its surroundings.

        Returns:
            The same as before where the crop does not show both sides.
        """
        distance = relative_distance(mask)
        inside, beside = distance > _INSIDE, (distance < -_BESIDE[0]) & (distance > -_BESIDE[1])
        if occluder is not None:
            inside, beside = inside & ~occluder, beside & ~occluder
        if not inside.any() or not beside.any():
            return before
        found = histograms(lab, inside, beside)
        return cls(found if before is None else (1 - _RATE) * before.histograms + _RATE * found)

    def log_ratio(self, lab: NDArray[np.uint8]) -> NDArray[np.float32]:
        """``(S, S)`` log of the object's over the surroundings' likelihood of each pixel's colour, within 3."""
        return log_ratio(self.histograms, lab)


def beside_outline(lab: NDArray[np.uint8], mask: NDArray[np.bool_], few: bool = False) -> NDArray[np.float32]:
    """``(S, S)`` log of how often a pixel's colour lies around it in the mask over how often beside it, within 3.

    Localised statistics as of Tjaden et al., "A region-based Gauss-Newton approach to real-time monocular multiple
    object tracking", 2018, over a few colours in place of fine histograms.

    Args:
        lab: ``(S, S, 3)`` crop in 8-bit Lab.
        mask: ``(S, S)`` where the object seems to be.
        few: Whether with fewer colours.
    """
    samples, colours = _FEWER if few else _PALETTE
    palette = Palette(lab, colours, max(round(len(lab) / samples), 1))
    labels = palette.label(lab)
    radius = max(round(_NEIGHBOURHOOD * math.sqrt(np.count_nonzero(mask))), 2)
    inside, beside = alike_around(labels, mask, radius, palette.size)
    return np.clip(np.log((inside + _RARE) / (beside + _RARE)), -_MOST, _MOST)


def alike_around(
    labels: NDArray[np.uint8], mask: NDArray[np.bool_], radius: int, size: int
) -> NDArray[np.float32]:
    """``(2, S, S)`` shares of what lies in a mask around a pixel that have its label, and of what lies beside it.

    Of less than a fiftieth of the neighbourhood the shares are those in so much.

    Args:
        labels: ``(S, S)``.
        mask: ``(S, S)``.
        radius: Half the side of the neighbourhood in pixels.
        size: More than any label.
    """
    from tracking3d.estimation.segmentation.kernels import colour_models

    return colour_models.alike_around(labels, mask, radius, size)


def relative_distance(
    mask: NDArray[np.bool_], distance: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """``(S, S)`` distance to the outline over the root of the area: positive inside, negative outside.

    Args:
        mask: ``(S, S)``.
        distance: ``(S, S)`` the same in pixels, where it is known already.
    """
    area = int(np.count_nonzero(mask))
    if area in (0, mask.size):  # without an outline everything is far on one side of it
        return np.full(mask.shape, 1.0 if area else -1.0, np.float32)
    return (inside_distance(mask) if distance is None else distance) / math.sqrt(area)


def outline_difference(first: NDArray[np.float32], second: NDArray[np.float32]) -> float | None:
    """How far two outlines are apart in the mean; None if they are nowhere near anything.

    Args:
        first: ``(S, S)`` relative distance to the one, see `relative_distance`.
        second: ``(S, S)`` to the other.
    """
    band = near_outlines(first, second)
    return float(np.abs(first - second)[band].mean()) if band.any() else None


def near_outlines(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.bool_]:
    """``(S, S)`` what is near either of two outlines; see `outline_difference`."""
    return np.minimum(np.abs(first), np.abs(second)) < _BAND


def as_lab(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``(S, S, 3)`` RGB to 8-bit CIE Lab."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
