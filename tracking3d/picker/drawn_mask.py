"""The mask of a drawing."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image
from tracking3d.picker.drawing import DrawnObject
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.first_mask import mask_in_box
from tracking3d.trackers.mask_from_points import mask_from_points

_SIZE = 320  # longer side in pixels at which colours are compared
_SEED = 0.012  # radius around a point that is certain, as a share of the longer side
_LEAST_CONTRAST = 2.0


def drawn_mask(
    image: Image, drawn: DrawnObject, present: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_] | None:
    """The mask ``(H, W)`` of what was drawn; None if nothing was, or only a box, which a tracker takes as it is.

    Points alone make the mask that they make as a prompt (`mask_from_points`); in a box they decide by colour (GrabCut,
    Rother et al. 2004, with the points as what is known). Paint is what it says.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        drawn: Box, points and strokes in pixels of the image.
        present: ``(H, W)`` the mask that paint alone changes; a box or points replace it. None starts from nothing.
    """
    if drawn.only_a_box:
        return None
    mask = np.zeros(image.shape[:2], np.uint8)
    if drawn.points and drawn.box is not None:
        mask = _in_box(image, drawn, drawn.box)
    elif drawn.points:
        mask = _of_points(image, drawn)
    elif drawn.box is not None:
        mask = (mask_in_box(image, drawn.box) >= 0.5).astype(np.uint8)
    elif present is not None:
        mask = present.astype(np.uint8)
    for stroke in drawn.strokes:
        path = np.array(stroke.path).round().astype(np.int32)
        radius, value = max(round(stroke.radius), 1), int(stroke.on)
        cv2.polylines(mask, [path], False, value, min(2 * radius, 32767))
        for end in (path[0], path[-1]):
            cv2.circle(mask, (int(end[0]), int(end[1])), radius, value, -1)
    return mask.astype(bool) if mask.any() else None


def _of_points(image: Image, drawn: DrawnObject) -> NDArray[np.uint8]:
    """The object by points alone, of those inside the image; nothing if none of them is on it."""
    height, width = image.shape[:2]
    points = [
        (one.x, one.y, one.on) for one in drawn.points if 0 <= one.x <= width - 1 and 0 <= one.y <= height - 1
    ]
    if not any(on for _, _, on in points):
        return np.zeros((height, width), np.uint8)
    return (mask_from_points(image, np.array(points, np.float32)) >= 0.5).astype(np.uint8)


def _in_box(image: Image, drawn: DrawnObject, box: Box) -> NDArray[np.uint8]:
    """The object in a box, by points on it and on the background."""
    height, width = image.shape[:2]
    scale = _SIZE / max(height, width)
    small = cv2.resize(
        image, (max(round(width * scale), 8), max(round(height * scale), 8)), interpolation=cv2.INTER_AREA
    )
    on = [(point.x * scale, point.y * scale) for point in drawn.points if point.on]
    off = [(point.x * scale, point.y * scale) for point in drawn.points if not point.on]
    labels = np.full(small.shape[:2], cv2.GC_BGD, np.uint8)
    inside = clip_box((box[0] * scale, box[1] * scale, box[2] * scale, box[3] * scale), small.shape)
    if inside is None:
        return np.zeros((height, width), np.uint8)
    left, top, across, down = (round(side) for side in inside)
    labels[top : top + down, left : left + across] = cv2.GC_PR_FGD
    radius = max(round(_SEED * _SIZE), 2)
    for points, label in ((on, cv2.GC_FGD), (off, cv2.GC_BGD)):
        for x, y in points:
            cv2.circle(labels, (round(x), round(y)), radius, int(label), -1)
    if small.std(axis=(0, 1)).max() >= _LEAST_CONTRAST and (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)
        cv2.grabCut(cv2.GaussianBlur(small, (3, 3), 0), labels, None, None, None, 4, cv2.GC_INIT_WITH_MASK)
    found = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    found = _touching(found, on) if on else found
    full = cv2.resize(found.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return (full >= 0.5).astype(np.uint8)


def _touching(found: NDArray[np.uint8], on: list[tuple[float, float]]) -> NDArray[np.uint8]:
    """The parts of a mask that a point is on."""
    _, parts = cv2.connectedComponents(found)
    height, width = found.shape
    kept = {parts[min(max(round(y), 0), height - 1), min(max(round(x), 0), width - 1)] for x, y in on} - {0}
    return np.isin(parts, list(kept)).astype(np.uint8)
