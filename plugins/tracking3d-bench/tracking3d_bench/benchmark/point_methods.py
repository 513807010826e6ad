"""Ways to follow points through a run's frames, to be compared: ours, and methods without a model.

All take the pixels of one frame and give positions ``(T, N, 2)``, NaN if there is none, and visibility ``(T, N)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
PointMethod = Callable[[int, Array], tuple[Array, NDArray[np.bool_]]]

_BACK = 1.0  # pixels by which the way back may miss


def chained_lucas_kanade(frames: Sequence[Grey]) -> PointMethod:
    """Sparse pyramidal flow from frame to frame; a point is visible until the way back misses it."""

    def step(a: Grey, b: Grey, xy: Array) -> Array:
        start = xy.astype(np.float32)[:, None]
        moved, found, _ = cv2.calcOpticalFlowPyrLK(a, b, start, None, winSize=(15, 15), maxLevel=3)
        good = (found[:, 0] > 0)[:, None]
        return np.where(good, moved[:, 0], np.nan).astype(np.float64)

    def follow(frame: int, xy: Array) -> tuple[Array, NDArray[np.bool_]]:
        positions, visible = _nowhere(len(frames), len(xy))
        positions[frame], visible[frame] = xy, True
        for before, now in _paths(frame, len(frames)):
            at = np.flatnonzero(np.isfinite(positions[before]).all(1))
            if not len(at):
                continue
            moved = step(frames[before], frames[now], positions[before, at])
            back = step(frames[now], frames[before], np.nan_to_num(moved))
            positions[now, at] = moved
            with np.errstate(invalid="ignore"):
                true = np.linalg.norm(back - positions[before, at], axis=1) < _BACK
            visible[now, at] = visible[before, at] & true
        return positions, visible

    return follow


def chained_dense_flow(frames: Sequence[Grey]) -> PointMethod:
    """OpenCV's dense inverse search from frame to frame (Kroeger et al., 2016), with the same check."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flows: dict[tuple[int, int], NDArray[np.float32]] = {}

    def at(a: int, b: int, xy: Array) -> Array:
        if (a, b) not in flows:
            flows[a, b] = search.calc(frames[a], frames[b], None)
        x, y = xy.astype(np.float32).T
        shift = cv2.remap(flows[a, b], x[None], y[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        moved: Array = xy + shift[0]
        return moved

    def follow(frame: int, xy: Array) -> tuple[Array, NDArray[np.bool_]]:
        positions, visible = _nowhere(len(frames), len(xy))
        positions[frame], visible[frame] = xy, True
        for before, now in _paths(frame, len(frames)):
            positions[now] = at(before, now, positions[before])
            back = at(now, before, positions[now])
            true = np.linalg.norm(back - positions[before], axis=1) < _BACK
            visible[now] = visible[before] & true
        return positions, visible

    return follow


def _nowhere(frames: int, points: int) -> tuple[Array, NDArray[np.bool_]]:
    return np.full((frames, points, 2), np.nan), np.zeros((frames, points), bool)


def _paths(start: int, frames: int) -> list[tuple[int, int]]:
    """Pairs of neighbours, from the start to the end and from the start to the beginning."""
    return [(n - 1, n) for n in range(start + 1, frames)] + [(n + 1, n) for n in range(start - 1, -1, -1)]
