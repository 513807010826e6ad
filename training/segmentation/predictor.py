"""The exported network at work: the first mask from a box, and a plain tracker to judge it by.

The tracker is no more than the network, flow and colours; the product's has more, see the package.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from batches import CROP
from channels import CUE_LIMIT, LOG_LIMIT
from network import CHANNELS, SIZE
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop, crop_window
from tracking3d.trackers.colour_models import GlobalColours
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.mask_motion import follow_mask
from tracking3d.trackers.outline import both_sides

Map = NDArray[np.float32]

_MARGIN = (CROP - 1) / 2
_FLOW_MARGIN, _FLOW_SIZE = 0.45, 224


class Predictor:
    """Runs the network on one video.

    Args:
        file: The ONNX file.
        threads: CPU threads.
    """

    def __init__(self, file: Path, threads: int = 1) -> None:
        self._network = Network(file, threads)
        self._image: Image | None = None
        self._mask: Map | None = None
        self._colours: GlobalColours | None = None

    def first(self, image: Image, box: Box) -> Map:
        """``(H, W)`` in [0, 1]: what the object is in ``box`` ``(x, y, w, h)`` of an RGB image."""
        window = Window.around(clip_box(box, image.shape) or box, _MARGIN, SIZE)
        channels = _rgb(image, window)
        left, top = (box[0] - window.left) * window.scale, (box[1] - window.top) * window.scale
        right, bottom = left + box[2] * window.scale, top + box[3] * window.scale
        left, top, right, bottom = (
            int(np.clip(round(value), 0, SIZE)) for value in (left, top, right, bottom)
        )
        channels[3, top:bottom, left:right] = 1
        channels[6] = 1
        object_, _ = self._run(channels)
        self._take(image, _pasted(object_, window, image.shape))
        assert self._mask is not None
        return self._mask

    def next(self, image: Image) -> tuple[Map, Map]:
        """``(H, W)`` in [0, 1] each: the object in the next frame, and what is in front of it."""
        assert self._image is not None
        assert self._mask is not None
        assert self._colours is not None
        box = box_of(self._mask)
        if box is None:
            return self._mask, np.zeros_like(self._mask)
        wide = Window.around(box, _FLOW_MARGIN, _FLOW_SIZE)
        last, present = FrameCrop.of(self._image, wide), FrameCrop.of(image, wide)
        motion = follow_mask(
            last.grey, present.grey, crop_window(self._mask, wide), in_frame=present.in_frame
        )
        carried = _pasted((motion.by_flow + motion.by_similarity) / 2, wide, image.shape)
        cue = _pasted(motion.cue, wide, image.shape)
        window = Window.around(box_of(carried) or box, _MARGIN, SIZE)
        channels = _rgb(image, window)
        channels[3] = crop_window(carried, window)
        channels[4] = self._colours.log_ratio(FrameCrop.of(image, window).lab) / LOG_LIMIT
        channels[5] = crop_window(cue, window) / CUE_LIMIT
        channels[7] = 1
        object_, occluder = (_pasted(one, window, image.shape) for one in self._run(channels))
        self._take(image, object_)
        return object_, occluder

    def _run(self, channels: Map) -> Map:
        logits = self._network.run({"crop": channels[None]})["logits"][0]
        return 1 / (1 + np.exp(-logits))

    def _take(self, image: Image, mask: Map) -> None:
        self._image, self._mask = image, mask
        if (box := box_of(mask)) is None:
            return
        view = FrameCrop.of(image, Window.around(box, _FLOW_MARGIN, _FLOW_SIZE))
        inside, around = both_sides(crop_window(mask, view.window))
        if self._colours is None:
            self._colours = GlobalColours(view.lab, inside, around & view.in_frame)
        else:
            self._colours.update(view.lab, inside, around & view.in_frame)


def _rgb(image: Image, window: Window) -> Map:
    channels = np.zeros((len(CHANNELS), SIZE, SIZE), np.float32)
    channels[:3] = crop_window(image, window).transpose(2, 0, 1).astype(np.float32) / 255 - 0.5
    return channels


def _pasted(values: Map, window: Window, shape: tuple[int, ...]) -> Map:
    """``(H, W)``: a window's values in the frame, 0 beyond it."""
    region = cv2.resize(values, (window.side, window.side), interpolation=cv2.INTER_LINEAR)
    full = np.zeros(shape[:2], np.float32)
    x0, y0 = max(window.left, 0), max(window.top, 0)
    x1, y1 = min(window.left + window.side, shape[1]), min(window.top + window.side, shape[0])
    if x1 > x0 and y1 > y0:
        full[y0:y1, x0:x1] = region[y0 - window.top : y1 - window.top, x0 - window.left : x1 - window.left]
    return full
