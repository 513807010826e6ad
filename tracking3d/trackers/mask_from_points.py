"""The first mask from points on the object and the background: geodesic distances, then GrabCut with the points as
seeds."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tracking3d.frames import Image
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.trackers.colour_models import lab
from tracking3d.trackers.crops import box_of, paste_mask

Points = NDArray[np.float32]
"""``(N, 3)``: x, y in pixels of the image, and 1 for the object or 0 for the background."""

_WHOLE, _SIZE = (
    200,
    288,
)  # pixels: longer side of the whole frame at first, side of the crop around the object then
_MARGIN = 0.35
_STEP = 2.0  # grey levels that one pixel of distance costs where colours are alike
_SEED = 2  # pixels: radius of what a point is sure of
_BAND = 17  # pixels of that crop on both sides of the outline within which it is drawn once more
_ITERATIONS = 5
_LEAST_CONTRAST = 2.0  # standard deviation in grey levels; below, colours tell nothing
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))


def mask_from_points(image: Image, points: Points) -> NDArray[np.float32]:
    """Segment the object that points tell of in an RGB ``image`` ``(H, W, 3)``; deterministic.

    A pixel begins as the object's where the way to a point on it, which is long across edges, is shorter than that to
    a background point or to the frame's border. From there the colours decide (GrabCut) in the whole frame, and once
    more about the outline at a finer resolution. Only parts with a point on them stay.

    Args:
        image: The frame.
        points: At least one of them on the object; all inside the frame.

    Returns:
        ``(H, W)`` in [0, 1]; a few pixels around the points where nothing in the image tells more.
    """
    height, width = image.shape[:2]
    scale = min(_WHOLE / max(height, width), 1.0)
    size = max(round(width * scale), 2), max(round(height * scale), 2)
    whole = lab(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    on, background = _seeds(
        (points[:, :2] + 0.5) * (size[0] / width, size[1] / height), points[:, 2], whole.shape
    )
    coarse = _grab_cut(whole, _nearer(whole, on, background), on, background, np.ones(on.shape, bool))
    coarse = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    around = box_of(coarse)
    if around is None:  # an object of less than a pixel at that size
        x, y = points[points[:, 2] > 0, :2].mean(0)
        around = float(x), float(y), 1.0, 1.0
    window = Window.around(around, _MARGIN, _SIZE)
    pixels = (points[:, :2] + 0.5 - (window.left, window.top)) * window.scale
    here = ((pixels >= 0) & (pixels < _SIZE)).all(1)
    inner = inside_frame(image.shape, window)
    on, background = _seeds(pixels[here], points[here, 2], inner.shape)
    likely = (crop_window(coarse, window) > 0.5) & inner
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _BAND + 1, 2 * _BAND + 1))
    on |= cv2.erode(likely.astype(np.uint8), near) > 0
    inner &= cv2.dilate((likely | on).astype(np.uint8), near) > 0
    return paste_mask(
        _grab_cut(lab(crop_window(image, window)), likely, on, background & ~on, inner), window, image.shape
    )


def _seeds(
    pixels: NDArray, kinds: NDArray, shape: tuple[int, ...]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """What the points are sure of: the object, and what is none of it. If both are near, the nearer point counts."""
    rows, columns = np.mgrid[: shape[0], : shape[1]] + 0.5
    gaps = []
    for kind in (1, 0):
        those = pixels[kinds == kind]
        gap = np.full(shape[:2], np.inf)
        for x, y in those:
            gap = np.minimum(gap, np.hypot(columns - x, rows - y))
        gaps.append(gap)
    on, background = gaps
    return (on <= _SEED) & (on <= background), (background <= _SEED) & (background < on)


def _nearer(
    colours: NDArray[np.uint8], on: NDArray[np.bool_], background: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Pixels from which the way to the object's seeds is shorter than to the others, or to the border."""
    border = np.ones(on.shape, bool)
    border[1:-1, 1:-1] = False
    smooth = cv2.GaussianBlur(colours, (3, 3), 0).reshape(-1, 3).astype(np.float32)
    number = np.arange(on.size).reshape(on.shape)
    height, width = on.shape
    starts, ends, costs = [], [], []
    for down, right in _NEIGHBOURS:
        start = number[: height - down, max(-right, 0) : width - max(right, 0)].ravel()
        end = number[down:, max(right, 0) : width - max(-right, 0)].ravel()
        change = np.linalg.norm(smooth[start] - smooth[end], axis=1)
        starts.append(start)
        ends.append(end)
        costs.append((change + _STEP) * np.hypot(down, right))
    edges = np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends))
    graph = coo_array(edges, shape=(on.size, on.size)).tocsr()
    to_object, to_rest = (
        dijkstra(graph, directed=False, indices=np.flatnonzero(seeds), min_only=True).reshape(on.shape)
        for seeds in (on, (background | border) & ~on)
    )
    return np.asarray(to_object < to_rest)


def _grab_cut(
    colours: NDArray[np.uint8],
    likely: NDArray[np.bool_],
    on: NDArray[np.bool_],
    background: NDArray[np.bool_],
    inside: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """The object by its colours, as far as it is connected to an object point; the likely pixels if colours are
    uniform."""
    labels = np.where(likely, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    labels[~inside | background] = cv2.GC_BGD
    labels[on & inside] = cv2.GC_FGD
    found = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if found.any() and not found.all() and colours.std(axis=(0, 1)).max() >= _LEAST_CONTRAST:
        cv2.setRNGSeed(0)  # the mixtures start from k-means, which draws from OpenCV's generator
        cv2.grabCut(colours, labels, None, None, None, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
        found = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    _, parts = cv2.connectedComponents(found.astype(np.uint8))
    return np.isin(parts, np.unique(parts[on & found]))
