"""Finding the object again, anywhere in the frame, by the colours that it had at first."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Window
from tracking3d.trackers.colour_models import GlobalColours, lab
from tracking3d.trackers.crops import cut, inside_frame
from tracking3d.trackers.outline import both_sides, remove_specks

_OVERVIEW = 160  # longer side in pixels of the image that is searched
_UNCHANGED = 6.0  # log-odds, as many as colours can say, that what was there without the object is not it
_LEAST_AREA, _MOST_AREA = (0.1, 2.5)  # of the object's usual area; while it comes in, only a part is seen


def find_by_colours(
    image: Image,
    colours: GlobalColours,
    area: float,
    margin: float,
    size: int,
    unchanged: NDArray[np.float32] | None = None,
) -> tuple[NDArray[np.bool_], Window, float] | None:
    """Segment what looks most like the object.

    Args:
        image: ``(H, W, 3)`` uint8 RGB.
        colours: What is known of the object.
        area: Its usual area in pixels of the frame.
        margin: Free space around it in the crop, relative to its size.
        size: Side of the crop in pixels.
        unchanged: ``(H, W)`` in [0, 1] how surely a pixel is what was seen of the background there, or None.

    Returns:
        The mask ``(size, size)`` in a window, the window, and how well its colours tell it from its surroundings,
        in [-1, 1]; None where nothing of a possible size has such colours.
    """
    scale = min(_OVERVIEW / max(image.shape[:2]), 1.0)
    overview = lab(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    likeness = np.tanh(colours.rarity(overview, overview))
    known = np.zeros(image.shape[:2], np.float32) if unchanged is None else unchanged
    known_overview = cv2.resize(known, overview.shape[1::-1], interpolation=cv2.INTER_AREA)
    likeness = np.minimum(likeness, 1 - 2 * known_overview)
    blurred = cv2.GaussianBlur(likeness, (0, 0), max(math.sqrt(area) * scale, 3.0) / 3)
    row, column = np.unravel_index(int(np.argmax(blurred)), blurred.shape)
    side = 1.3 * math.sqrt(area)
    left, top = ((at + 0.5) / scale - side / 2 for at in (column, row))
    window = Window.around((left, top, side, side), margin, size)

    crop, in_frame = cut(image, window), inside_frame(image.shape, window)
    rows, columns = np.mgrid[:size, :size] + 0.5 - size / 2
    evidence = 2 * colours.rarity(lab(crop), overview) + 1 - np.hypot(rows, columns) / (0.3 * size)
    evidence -= _UNCHANGED * cut(known, window)
    support = np.tanh(evidence / 3).astype(np.float32)
    smooth = cv2.ximgproc.fastGlobalSmootherFilter(crop, support, 100.0, 12.0)
    found = (smooth > 0) & in_frame
    mask = _largest(remove_specks(found, found))
    if not _LEAST_AREA * area <= np.count_nonzero(mask) / window.scale**2 <= _MOST_AREA * area:
        return None
    inside, around = both_sides(mask)
    return mask, window, colours.separation(lab(crop), inside, around & in_frame)


def _largest(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    stats[0, cv2.CC_STAT_AREA] = 0
    largest = int(np.argmax(stats[:, cv2.CC_STAT_AREA]))
    return mask & (labels == largest)
