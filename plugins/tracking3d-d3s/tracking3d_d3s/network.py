"""D3S' segmentation network in an ONNX file, and what leads it from frame to frame.

Crops, normalisation, distance map, thresholds and the limits of the scale's change are those of the D3S project
(https://github.com/alanlukezic/d3s, ``pytracking/tracker/segm/segm.py`` and its default parameters). Its other
half, a correlation filter trained online on ResNet features, is no network that can be exported; OpenCV's CSR-DCF
stands in for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, PluginError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.trackers.crops import box_iou, box_of, clip_box, paste_mask
from tracking3d.trackers.csrt import BoxTracker, CsrtTracker

_INPUTS = {"train_imgs": 3, "test_imgs": 3, "train_masks": 1, "test_dist": 1}
"""Inputs and their channels: the arguments of ``SegmNet.forward``."""

_SIZE = 384  # segm_feature_sz * 16
_SEARCH = 4.0  # segm_search_area_factor: side of the crop over the square root of the box's area
_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)
_LEAST_AREA = 50  # pixels of the crop; a smaller object is not believed
_GIVEN_MASK = 0.1  # above which a pixel of a resized first mask is the object
_SCALE_CHANGE = (0.95, 1.05)  # of the box in one frame
_STRAYED = 0.3  # IoU of the filter's and the mask's boxes below which the filter starts anew


@dataclass(frozen=True, eq=False)
class _Template:
    """The object in the first frame: normalised crop ``(1, 3, S, S)`` and mask ``(1, 1, S, S)``."""

    image: NDArray[np.float32]
    mask: NDArray[np.float32]


class D3sNetwork:
    """Tracks by D3S' segmentation network. A mask tracker, see `tracking3d.trackers.protocol.MaskTracker`.

    Args:
        network: Inputs ``train_imgs`` and ``test_imgs`` ``(1, 3, S, S)``, ``train_masks`` and ``test_dist``
            ``(1, 1, S, S)``; first output ``(1, 2, S, S)``, logits of object and background.
        threshold: Probability above which a pixel is the object.
        follow_filter: Whether CSR-DCF says where to look; else the last mask.

    Raises:
        InputError: If the network has other inputs or outputs.
    """

    def __init__(self, network: Network, threshold: float = 0.5, follow_filter: bool = True) -> None:
        self._network = network
        self._size = _checked_size(network)
        self._threshold = threshold
        self._follow_filter = follow_filter
        self._template: _Template | None = None
        self._filter: BoxTracker | None = None
        self._box: Box = (0.0, 0.0, 1.0, 1.0)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a mask, or from a box in which the network segments the first mask.

        Raises:
            InputError: If the box lies outside the frame.
        """
        image = frame.image
        box = clip_box(prompt.box, image.shape)
        if box is None:
            raise InputError(
                f"The box {prompt.box} lies outside {frame.name or 'the first frame'}; give a box inside it."
            )
        self._box = box
        window = self._window(box)
        pixels = _normalised(crop_window(image, window))
        if prompt.mask is not None:
            given = crop_window(prompt.mask.astype(np.float32), window) * inside_frame(image.shape, window)
            self._template = _Template(pixels, _plane(given > _GIVEN_MASK))
            answer = MaskEstimate(prompt.mask.astype(np.float32))
        else:
            inside = _box_mask(box, window)
            probability = self._run(_Template(pixels, _plane(inside)), pixels)
            mask = (probability > self._threshold) & inside
            reason = "" if mask.any() else "D3S found nothing in the box, which is taken whole"
            mask = mask if mask.any() else inside
            self._template = _Template(pixels, _plane(mask))
            score = float(probability[mask].mean())
            answer = MaskEstimate(paste_mask(mask, window, image.shape), score, reason)
        self._filter = BoxTracker(CsrtTracker.Options(), image, box) if self._follow_filter else None
        return answer

    def step(self, frame: Frame) -> MaskEstimate:
        """Segment the next frame."""
        if self._template is None:
            raise PluginError("The tracker d3s was asked for a frame before it was started with init.")
        found = self._filter.update(frame.image) if self._filter else None
        if found is not None:
            self._box = _moved(self._box, _centre(found), frame.image.shape)
        window = self._window(self._box)
        probability = self._run(self._template, _normalised(crop_window(frame.image, window)))
        mask = _largest((probability > self._threshold) & inside_frame(frame.image.shape, window))
        if mask is None:
            return MaskEstimate(None, 0.0, "D3S finds no object")
        answer = paste_mask(mask, window, frame.image.shape)
        box = box_of(answer)
        if box is None:
            return MaskEstimate(None, 0.0, "D3S finds less than a pixel")
        self._follow(frame.image, box, found)
        return MaskEstimate(answer, float(probability[mask].mean()))

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``frame``; the template stays that of the first frame."""
        if (box := box_of(mask)) is not None and self._template is not None:
            self._box = box
            if self._filter is not None:
                self._filter = BoxTracker(CsrtTracker.Options(), frame.image, box)

    def _follow(self, image: Image, box: Box, found: Box | None) -> None:
        """Take the mask's box for the object's place, and let its size change a little."""
        change = math.sqrt(box[2] * box[3] / (self._box[2] * self._box[3]))
        factor = min(max(change, _SCALE_CHANGE[0]), _SCALE_CHANGE[1])
        x, y, width, height = self._box
        self._box = _moved((x, y, width * factor, height * factor), _centre(box), image.shape)
        if self._filter is not None and (found is None or box_iou(found, box) < _STRAYED):
            self._filter = BoxTracker(CsrtTracker.Options(), image, box)

    def _window(self, box: Box) -> Window:
        side = max(math.ceil(_SEARCH * math.sqrt(box[2] * box[3])), 4)
        x, y = _centre(box)
        return Window(round(x - side / 2), round(y - side / 2), side, self._size)

    def _run(self, template: _Template, pixels: NDArray[np.float32]) -> NDArray[np.float32]:
        """``(S, S)``: the probability of the object."""
        steps = np.arange(1, self._size + 1, dtype=np.float32) - self._size / 2
        distance = np.hypot(steps[:, None], steps)
        answers = self._network.run(
            {
                "train_imgs": template.image,
                "test_imgs": pixels,
                "train_masks": template.mask,
                "test_dist": distance[None, None],
            }
        )
        logits = next(iter(answers.values()))
        if logits.shape != (1, 2, self._size, self._size):
            raise InputError(
                f"{self._network.file} answers with {logits.shape} instead of (1, 2, {self._size}, {self._size}); see "
                "the README of tracking3d-d3s for the export."
            )
        with np.errstate(over="ignore"):
            probability = 1 / (1 + np.exp(logits[0, 1] - logits[0, 0]))
        return probability.astype(np.float32)


def _checked_size(network: Network) -> int:
    """The side of the network's crops."""
    for name, channels in _INPUTS.items():
        info = network.inputs.get(name)
        if info is None or len(info.shape) != 4 or info.shape[1] not in (channels, None):
            raise InputError(
                f"{network.file} is no export of D3S: it has no input '{name}' (1, {channels}, {_SIZE}, {_SIZE}); see "
                "the README of tracking3d-d3s for the export."
            )
    return network.inputs["test_imgs"].shape[-1] or _SIZE


def _normalised(crop: NDArray[np.uint8]) -> NDArray[np.float32]:
    values = (crop.astype(np.float32) / 255 - _MEAN) / _STD
    return np.ascontiguousarray(values.transpose(2, 0, 1), np.float32)[None]


def _plane(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    return mask.astype(np.float32)[None, None]


def _box_mask(box: Box, window: Window) -> NDArray[np.bool_]:
    """``(S, S)``: the pixels of the window whose centres lie in the box; the middle one at least."""
    centres = (np.arange(window.size) + 0.5) / window.scale
    columns, rows = window.left + centres, window.top + centres
    inside = ((rows >= box[1]) & (rows <= box[1] + box[3]))[:, None] & (
        (columns >= box[0]) & (columns <= box[0] + box[2])
    )
    inside[window.size // 2, window.size // 2] = True
    return inside


def _largest(mask: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    """The largest connected part, holes filled, or None where it is too small."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = max(contours, key=cv2.contourArea, default=None)
    if contour is None or cv2.contourArea(contour) <= _LEAST_AREA:
        return None
    canvas = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(canvas, [contour], -1, 1, thickness=-1)
    return canvas.astype(bool)


def _centre(box: Box) -> tuple[float, float]:
    return box[0] + box[2] / 2, box[1] + box[3] / 2


def _moved(box: Box, centre: tuple[float, float], shape: tuple[int, ...]) -> Box:
    """The box about another centre, which stays inside a frame of ``shape``."""
    x, y = min(max(centre[0], 0.0), shape[1] - 1.0), min(max(centre[1], 0.0), shape[0] - 1.0)
    return x - box[2] / 2, y - box[3] / 2, box[2], box[3]
