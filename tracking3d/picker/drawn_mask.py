"""From what was drawn to a mask. Where prompts by points are made into masks elsewhere, `drawn_mask` is the seam."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.picker.drawing import DrawnObject
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.first_mask import mask_in_box

_SIZE = 320  # longer side in pixels at which colours are compared
_SEED = 0.012  # radius around a point that is certain, as a share of the longer side
_REACH = (
    0.22  # of the longer side: how far from the points, at first, the object may reach where no box says it
)
_LEAST_CONTRAST = 2.0


def drawn_mask(image: Image, drawn: DrawnObject) -> NDArray[np.bool_] | None:
    """The mask ``(H, W)`` of what was drawn; None where nothing was, or only a box, which a tracker takes as it is.

    Points decide by colour (GrabCut, Rother et al. 2004, with the points as what is known); paint is what it says.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        drawn: Box, points and strokes in pixels of the image.
    """
    if drawn.only_a_box:
        return None
    mask = np.zeros(image.shape[:2], np.uint8)
    if drawn.points:
        mask = _of_points(image, drawn)
    elif drawn.box is not None:
        mask = (mask_in_box(image, drawn.box) >= 0.5).astype(np.uint8)
    for stroke in drawn.strokes:
        path = np.array(stroke.path).round().astype(np.int32)
        radius, value = max(round(stroke.radius), 1), int(stroke.on)
        cv2.polylines(mask, [path], False, value, min(2 * radius, 32767))
        for end in (path[0], path[-1]):
            cv2.circle(mask, (int(end[0]), int(end[1])), radius, value, -1)
    return mask.astype(bool) if mask.any() else None


def _of_points(image: Image, drawn: DrawnObject) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    scale = _SIZE / max(height, width)
    small = cv2.resize(
        image, (max(round(width * scale), 8), max(round(height * scale), 8)), interpolation=cv2.INTER_AREA
    )
    on = [(point.x * scale, point.y * scale) for point in drawn.points if point.on]
    beside = [(point.x * scale, point.y * scale) for point in drawn.points if not point.on]
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    labels[_candidates(small.shape[:2], drawn, on, scale)] = cv2.GC_PR_FGD
    if not (labels == cv2.GC_PR_FGD).any():
        return np.zeros((height, width), np.uint8)
    radius = max(round(_SEED * _SIZE), 2)
    for points, label in ((on, cv2.GC_FGD), (beside, cv2.GC_BGD)):
        for x, y in points:
            cv2.circle(labels, (round(x), round(y)), radius, int(label), -1)
    if small.std(axis=(0, 1)).max() >= _LEAST_CONTRAST and (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        cv2.grabCut(cv2.GaussianBlur(small, (3, 3), 0), labels, None, None, None, 4, cv2.GC_INIT_WITH_MASK)
    found = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    found = _touching(found, on) if on else found
    full = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return (full >= 0.5).astype(np.uint8)


def _candidates(
    shape: tuple[int, int], drawn: DrawnObject, on: list[tuple[float, float]], scale: float
) -> NDArray[np.bool_]:
    """Where the object may be: in the box, else near the points that are on it."""
    inside = np.zeros(shape, np.uint8)
    if drawn.box is not None:
        box = clip_box(tuple(side * scale for side in drawn.box), shape)  # type: ignore[arg-type]
        if box is not None:
            x, y, width, height = (round(side) for side in box)
            inside[y : y + height, x : x + width] = 1
    elif on:
        hull = cv2.convexHull(np.array(on, np.float32).round().astype(np.int32))
        cv2.polylines(inside, [hull], True, 1, max(round(2 * _REACH * _SIZE), 1))
        cv2.fillPoly(inside, [hull], 1)
    return inside.astype(bool)


def _touching(found: NDArray[np.uint8], on: list[tuple[float, float]]) -> NDArray[np.uint8]:
    """The parts of a mask that a point is on."""
    _, parts = cv2.connectedComponents(found)
    height, width = found.shape
    kept = {parts[min(max(round(y), 0), height - 1), min(max(round(x), 0), width - 1)] for x, y in on} - {0}
    return np.isin(parts, list(kept)).astype(np.uint8)
