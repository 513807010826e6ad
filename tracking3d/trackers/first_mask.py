"""The first mask: the object inside a box, by GrabCut (Rother et al. 2004), and by a network if there is one."""

from __future__ import annotations

import logging

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.trackers.colour_models import lab
from tracking3d.trackers.crops import clip_box, paste_mask

_SIZE = 288
_MARGIN = 0.35
_COLOURS = 0.5  # weight of GrabCut's mask beside the network's
_ITERATIONS = 5
_LEAST_SHARE = 0.15  # of the box; less is taken for a failure
_LEAST_CONTRAST = (
    2.0  # standard deviation in grey levels; below, the graph cut takes minutes and means nothing
)
_log = logging.getLogger(__name__)


def mask_in_box(image: Image, box: Box, warns: bool = False) -> NDArray[np.float32]:
    """Segment the object in ``box`` ``(x, y, w, h)`` of an RGB ``image`` ``(H, W, 3)``; deterministic.

    Where GrabCut finds next to nothing the ellipse inscribed in the box stands in; whether that is said is ``warns``.

    Returns:
        ``(H, W)`` in [0, 1]; all zero where the box lies outside the image.
    """
    visible = clip_box(box, image.shape)
    if visible is None:
        return np.zeros(image.shape[:2], np.float32)
    window = Window.around(visible, _MARGIN, _SIZE)
    rows, columns = _in_window(visible, window)
    candidate = np.zeros((_SIZE, _SIZE), bool)
    candidate[rows, columns] = True
    candidate &= inside_frame(image.shape, window)
    mask = _grab_cut(lab(crop_window(image, window)), candidate)
    if np.count_nonzero(mask) < _LEAST_SHARE * np.count_nonzero(candidate):
        mask = _ellipse(rows, columns)
        if warns:
            _log.warning(
                "No outline was found in the box, and the ellipse in it stands for the object; give it by --mask or "
                "--points."
            )
    return paste_mask(mask, window, image.shape)


def mask_with_network(image: Image, box: Box, likely: NDArray[np.float32]) -> NDArray[np.float32]:
    """Segment the object in a box by a network, and by colours with half of its say; deterministic.

    Colours keep to outlines that the network draws too smoothly, and the network knows what belongs together though its
    colours differ.

    Args:
        image: ``(H, W, 3)`` RGB.
        box: ``(x, y, w, h)`` in pixels.
        likely: ``(H, W)`` in [0, 1], the network's probability.

    Returns:
        ``(H, W)`` of 0 and 1.
    """
    by_colours = mask_in_box(image, box, warns=True)
    mask = (likely + _COLOURS * by_colours > (1 + _COLOURS) / 2).astype(np.float32)
    visible = clip_box(box, image.shape)
    enough = visible is None or mask.sum() > _LEAST_SHARE * visible[2] * visible[3]
    return mask if enough else by_colours


def _grab_cut(colours: NDArray[np.uint8], candidate: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The object among the candidate pixels; empty if colours do not separate it."""
    if candidate.all() or not candidate.any() or colours.std(axis=(0, 1)).max() < _LEAST_CONTRAST:
        return np.zeros_like(candidate)
    labels = np.where(candidate, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    cv2.setRNGSeed(0)  # the mixtures start from k-means, which draws from OpenCV's generator
    cv2.grabCut(colours, labels, None, None, None, _ITERATIONS, cv2.GC_INIT_WITH_MASK)
    return labels == cv2.GC_PR_FGD


def _in_window(box: Box, window: Window) -> tuple[slice, slice]:
    x, y = (box[0] - window.left) * window.scale, (box[1] - window.top) * window.scale
    width, height = box[2] * window.scale, box[3] * window.scale
    return slice(round(y), round(y + height)), slice(round(x), round(x + width))


def _ellipse(rows: slice, columns: slice) -> NDArray[np.bool_]:
    y, x = np.mgrid[:_SIZE, :_SIZE] + 0.5
    across = (2 * x - columns.start - columns.stop) / (columns.stop - columns.start)
    down = (2 * y - rows.start - rows.stop) / (rows.stop - rows.start)
    return across**2 + down**2 <= 1
