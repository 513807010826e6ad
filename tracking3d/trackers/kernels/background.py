"""Kernels of `tracking3d.trackers.background`: a pixel's difference from its memory, and its learning, in one pass."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, kernel


def differences(
    present: NDArray[np.uint8],
    highest: NDArray[np.float32],
    lowest: NDArray[np.float32],
    variance: NDArray[np.float32],
    least_variance: float,
) -> NDArray[np.float32]:
    """See `tracking3d.trackers.background.differences`."""
    found = np.empty(variance.shape, np.float32)
    # A copy, since frames are read only.
    _differences(np.array(present), highest, lowest, variance, np.float32(least_variance), found)
    return found


def learn(
    present: NDArray[np.uint8],
    familiar: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    proof: NDArray[np.float32],
    memory: tuple[NDArray[np.float32], ...],
    constants: tuple[float, ...],
) -> None:
    """See `tracking3d.trackers.background.learn`."""
    mean, variance, frames, proven = memory
    limits = np.array(constants, np.float32)
    _learn(np.array(present), familiar, seen, proof, mean, variance, frames, proven, limits)


@kernel("void(uint8[:,:,:], float32[:,:,:], float32[:,:,:], float32[:,:], float32, float32[:,::1])")
def _differences(present, highest, lowest, variance, least_variance, found):
    rows, columns = found.shape
    for row in range(rows):
        for column in range(columns):
            total = np.float32(0)
            for channel in range(3):
                value = np.float32(present[row, column, channel])
                above = value - highest[row, column, channel]
                below = lowest[row, column, channel] - value
                beyond = max(above, below, np.float32(0))
                total += beyond * beyond
            found[row, column] = total / np.float32(3) / (variance[row, column] + least_variance)


@kernel(
    "void(uint8[:,:,:], boolean[:,:], boolean[:,:], float32[:,:], float32[:,:,:], float32[:,:], float32[:,:], "
    "float32[:,:], float32[::1])"
)
def _learn(present, familiar, seen, proof, mean, variance, frames, proven, constants):
    least_rate, first_variance, least_variance, lasting = constants
    rows, columns = frames.shape
    for row in range(rows):
        for column in range(columns):
            if not seen[row, column]:
                continue
            known = frames[row, column]
            if known < np.float32(0.9):
                for channel in range(3):
                    mean[row, column, channel] = present[row, column, channel]
                variance[row, column] = first_variance
                frames[row, column] = _within(known + np.float32(1), lasting)
                proven[row, column] = _within(proof[row, column], np.float32(1))
                continue
            if familiar[row, column]:
                rate, spread = max(np.float32(1) / (known + np.float32(1)), least_rate), np.float32(0)
                for channel in range(3):
                    difference = np.float32(present[row, column, channel]) - mean[row, column, channel]
                    mean[row, column, channel] += rate * difference
                    spread += difference * difference
                spread = spread / np.float32(3) - variance[row, column]
                variance[row, column] = max(variance[row, column] + rate * spread, least_variance)
                frames[row, column] = _within(known + np.float32(1), lasting)
            else:
                frames[row, column] = _within(known - np.float32(1), lasting)
            proven[row, column] = _within(proven[row, column] + proof[row, column], np.float32(1))


@numba.njit(**OPTIONS)
def _within(value, most):
    return min(max(value, np.float32(0)), most)
