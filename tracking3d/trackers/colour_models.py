"""Colour models of an object and its surroundings: a global one with memory, and a local one."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_BINS = (16, 12, 12)  # L, a, b
_LOG_LIMIT = 3.0
_CELL_BITS = 5  # bits a channel of the cells whose colours share a palette entry
_PACKED = 256 ** np.arange(3)  # one number for a colour


def lab(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``(H, W, 3)`` RGB to 8-bit CIE Lab."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2LAB)


class GlobalColours:
    """Lab histograms of object and background: those of the first mask, and running ones.

    Args:
        colours: ``(S, S, 3)`` Lab crop with the first mask.
        mask: ``(S, S)`` bool, the object.
        background: ``(S, S)`` bool, what is surely not the object.
        memory: Share of the first mask's histograms in the mixture.
        rate: How fast the running histograms follow.
    """

    def __init__(
        self,
        colours: NDArray[np.uint8],
        mask: NDArray[np.bool_],
        background: NDArray[np.bool_],
        memory: float = 0.5,
        rate: float = 0.1,
    ) -> None:
        self._memory, self._rate = memory, rate
        self._first = histograms(colours, mask, background)
        self._running = self._first

    def update(
        self, colours: NDArray[np.uint8], mask: NDArray[np.bool_], background: NDArray[np.bool_]
    ) -> None:
        """Let the running histograms follow a mask that is trusted."""
        self._running = (1 - self._rate) * self._running + self._rate * histograms(colours, mask, background)

    def log_ratio(self, colours: NDArray[np.uint8]) -> NDArray[np.float32]:
        """``(S, S)``: log of object over background likelihood of each pixel, clipped at 3."""
        return log_ratio(self._memory * self._first + (1 - self._memory) * self._running, colours)

    def rarity(self, colours: NDArray[np.uint8], image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """``(S, S)``: log of the first object's likelihood of each pixel over its share of a whole ``image``.

        Args:
            colours: ``(S, S, 3)`` Lab crop of the image.
            image: ``(H, W, 3)`` Lab.
        """
        everywhere = np.ones(image.shape[:2], bool)
        return log_ratio(np.stack([self._first[0], histograms(image, everywhere, everywhere)[0]]), colours)

    def separation(
        self, colours: NDArray[np.uint8], mask: NDArray[np.bool_], background: NDArray[np.bool_]
    ) -> float:
        """How much more the mask looks like the first frame's object than its surroundings do, in [-1, 1]."""
        if not mask.any() or not background.any():
            return 0.0
        likeness = np.tanh(log_ratio(self._first, colours))
        return float(likeness[mask].mean() - likeness[background].mean()) / 2


def _bin(colours: NDArray[np.uint8]) -> NDArray[np.int32]:
    index = np.zeros(colours.shape[:2], np.int32)
    for channel, bins in enumerate(_BINS):
        index = index * bins + colours[..., channel].astype(np.int32) * bins // 256
    return index


def histograms(
    colours: NDArray[np.uint8], mask: NDArray[np.bool_], background: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """``(2, B)`` shares of the colours of a Lab crop ``(S, S, 3)`` in the mask, and in the background."""
    index, size = _bin(colours), int(np.prod(_BINS))
    counts = np.stack([np.bincount(index[where], minlength=size) for where in (mask, background)]).astype(
        float
    )
    # Neighbouring bins share counts: a shade seen once should not make its neighbour impossible.
    smooth = np.stack([_smooth(c.reshape(_BINS)).ravel() for c in counts])
    return smooth / np.maximum(smooth.sum(1, keepdims=True), 1.0)


def _smooth(cube: NDArray[np.float64]) -> NDArray[np.float64]:
    for axis in range(cube.ndim):
        padded = np.pad(cube, [(int(a == axis),) * 2 for a in range(cube.ndim)], mode="edge")
        below, above = (np.take(padded, np.arange(s, s + cube.shape[axis]), axis) for s in (0, 2))
        cube = 0.25 * below + 0.5 * cube + 0.25 * above
    return cube


def log_ratio(
    histograms: NDArray[np.float64], colours: NDArray[np.uint8], floor: float = 1e-4
) -> NDArray[np.float32]:
    """``(S, S)`` log of the first over the second likelihood of each pixel of a Lab crop, clipped at 3.

    Args:
        histograms: ``(2, B)`` from `histograms`.
        colours: ``(S, S, 3)``.
        floor: Added to both; rarer colours are evidence for neither side. About five pixels of a crop if left out.
    """
    table = np.log((histograms[0] + floor) / (histograms[1] + floor))
    return np.clip(table, -_LOG_LIMIT, _LOG_LIMIT).astype(np.float32)[_bin(colours)]


class Palette:
    """A few colours that stand for all (k-means in Lab), to compare where each of them lay.

    Args:
        colours: ``(S, S, 3)`` Lab crop to take the colours from.
        size: Number of colours.
        stride: Every how many pixels of the crop one is asked, along both sides.
    """

    def __init__(self, colours: NDArray[np.uint8], size: int = 40, stride: int = 3) -> None:
        from scipy.spatial import cKDTree  # slow to import; the options of a tracker are checked without it

        samples = colours[::stride, ::stride].reshape(-1, 3)
        size = min(size, len(np.unique(samples.astype(np.int32) @ _PACKED)))
        cv2.setRNGSeed(0)  # k-means++ draws from OpenCV's generator
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 1.0)
        _, _, centres = cv2.kmeans(samples.astype(np.float32), size, None, criteria, 1, cv2.KMEANS_PP_CENTERS)
        self._nearest = cKDTree(centres)
        self.size = size

    def label(self, colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """``(S, S)``: the palette entry nearest to each pixel, up to `_CELL_BITS`."""
        short = colours.astype(np.int32) >> (8 - _CELL_BITS)
        cells = (short[..., 0] << 2 * _CELL_BITS) + (short[..., 1] << _CELL_BITS) + short[..., 2]
        present = np.flatnonzero(np.bincount(cells.ravel()))  # a crop shows few of all the colours
        middles = np.stack(np.unravel_index(present, (1 << _CELL_BITS,) * 3), -1) + 0.5
        table = np.zeros(int(present[-1]) + 1, np.uint8)
        table[present] = self._nearest.query(middles * (256 >> _CELL_BITS))[1]
        return table[cells]

    def local_log_ratio(
        self,
        labels: NDArray[np.uint8],
        last_labels: NDArray[np.uint8],
        last_mask: NDArray[np.float32],
        radius: int,
    ) -> NDArray[np.float32]:
        """``(S, S)``: was a pixel's colour object or background within ``radius`` pixels, one frame ago?

        Args:
            labels: ``(S, S)`` palette entries of the present crop.
            last_labels: ``(S, S)`` those of the last crop, warped onto the present one.
            last_mask: ``(S, S)`` in [0, 1], the last mask, warped alike.
            radius: Half the side of the neighbourhood in pixels.
        """
        side, floor = (2 * radius + 1,) * 2, 0.002
        total = np.maximum(np.stack([cv2.blur(m, side) for m in (last_mask, 1 - last_mask)]), 0.02)
        shares = local_shares(labels, last_labels, last_mask, radius, self.size) / total
        ratio = np.log((shares[0] + floor) / (shares[1] + floor))
        return np.clip(ratio, -_LOG_LIMIT, _LOG_LIMIT)


def local_shares(
    labels: NDArray[np.uint8],
    last_labels: NDArray[np.uint8],
    last_mask: NDArray[np.float32],
    radius: int,
    size: int,
) -> NDArray[np.float32]:
    """``(2, S, S)``: the shares of a pixel's neighbourhood that had its label inside the mask, and outside.

    Args:
        labels: See `Palette.local_log_ratio`.
        last_labels: Likewise.
        last_mask: Likewise.
        radius: Likewise.
        size: More than any label.
    """
    from tracking3d.trackers.kernels import colour_models

    return colour_models.local_shares(labels, last_labels, last_mask, radius, size)
