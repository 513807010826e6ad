"""One view added to the sums over all views, by whole arrays."""

from __future__ import annotations

import numpy as np

from tracking3d.reconstruction.texturing import _STEEPNESS, _VOTED_DOWN, FloatArray, Seen


def add_view(
    total: FloatArray,
    weight: FloatArray,
    seen: Seen,
    gain: FloatArray,
    expected: FloatArray,
    sharpness: float,
) -> None:
    """See `tracking3d.reconstruction.texturing.add_view`."""
    texel, colours, how_well = seen
    colours = gain * colours.T
    apart = np.square(colours - expected[texel]).sum(1) / _VOTED_DOWN**2
    say = (how_well * np.float32(sharpness)) ** _STEEPNESS / (1 + apart)
    total[texel] += say[:, None] * colours
    weight[texel] += say
