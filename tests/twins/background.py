"""The background memory's difference and learning, by whole arrays."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.trackers.background import _LASTING, _LEAST_NOISE, _LEAST_VARIANCE, _NOISE, _RATE, _Memory


def differences(
    present: NDArray[np.uint8], mean: NDArray[np.float32], variance: NDArray[np.float32]
) -> NDArray[np.float32]:
    """See `tracking3d.trackers.background.differences`."""
    square = np.ones((3, 3), np.uint8)
    highest, lowest = cv2.dilate(mean, square), cv2.erode(mean, square)
    values = present.astype(np.float32)
    beyond = np.maximum(np.maximum(values - highest, lowest - values), 0)
    return _mean_square(beyond) / (variance + _LEAST_NOISE**2)


def learn(
    present: NDArray[np.uint8],
    familiar: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    proof: NDArray[np.float32],
    memory: _Memory,
) -> None:
    """See `tracking3d.trackers.background.learn`."""
    mean, variance, frames, proven = memory
    new = seen & (frames < 0.9)
    familiar = familiar & seen & ~new
    rate = familiar * np.maximum(1 / (frames + 1), np.float32(_RATE))
    difference = present - mean
    variance += rate * (_mean_square(difference) - variance)
    np.maximum(variance, _LEAST_VARIANCE, out=variance, where=familiar)
    variance[new] = _NOISE**2  # the first value tells nothing of the noise
    mean += np.where(new, 1, rate)[..., None] * difference
    frames += np.where(familiar | new, 1, -1) * seen
    np.clip(frames, 0, _LASTING, out=frames)
    proven[new] = 0
    proven += seen * proof
    np.clip(proven, 0, 1, out=proven)


def _mean_square(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over the channels."""
    return np.einsum("ijk,ijk->ij", values, values) / values.shape[2]
