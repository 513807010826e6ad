"""The box tracker NanoTrack on onnxruntime: a Siamese network compares a template with the region around the last box.

Its third version has a head that ``cv2.TrackerNano`` rejects. The method and its constants are those of
https://github.com/HonglinChu/SiamTrackers (NanoTrack, ``configv3.yaml``), after SiamBAN (Chen et al., CVPR 2020).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box, Image
from tracking3d.networks.session import Network
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.onnx.images import TRIAL_BOX, TRIAL_IMAGE

_TEMPLATE, _SEARCH = 127, 255  # pixels: sides of the template and of the search region
_STRIDE = 16
_GRID = 15  # of the scores
_INNER = slice(4, 12)  # the template's part of a search region's features, which are 16 x 16
_CONTEXT = 0.5  # of the mean of the box's sides, around the box
_WINDOW_WEIGHT, _SHAPE_PENALTY, _SIZE_RATE = 0.455, 0.138, 0.348
_LEAST_SIDE = 10.0  # pixels of a box


@dataclass(frozen=True)
class _Place:
    """Centre ``(x, y)`` and size ``(width, height)`` of a box, in pixels."""

    centre: NDArray[np.float64]
    size: NDArray[np.float64]

    @property
    def template_side(self) -> float:
        """Side of the square around the box that becomes the template, in pixels."""
        return float(_side_with_context(self.size))


class SiameseBoxes:
    """NanoTrack of version 3, deterministic; see `tracking3d.trackers.onnx.boxes.BoxProposer`.

    Args:
        backbone: ONNX file: ``(1, 3, 255, 255)`` BGR in 0 to 255 to features ``(1, C, 16, 16)``.
        head: ONNX file: template ``(1, C, 8, 8)`` and features ``(1, C, 16, 16)`` to scores ``(1, 2, S, S)`` and
            distances to the four sides ``(1, 4, S, S)``.
        threads: CPU threads.

    Raises:
        InputError: If a file is not such a network.
    """

    def __init__(self, backbone: Path, head: Path, threads: int = 1) -> None:
        self._backbone, self._head = Network(backbone, threads), Network(head, threads)
        for network, inputs in ((self._backbone, 1), (self._head, 2)):
            if len(network.inputs) != inputs or len(network.outputs) != inputs:
                raise InputError(
                    f"{network.file} is not a network of NanoTrack 3: it has {len(network.inputs)} inputs and "
                    f"{len(network.outputs)} outputs, not {inputs} of each; give its backbone and its head."
                )
        self._template: NDArray[np.float32]
        try:
            self.start(TRIAL_IMAGE, TRIAL_BOX)
            self.update(TRIAL_IMAGE)
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{backbone} and {head} are not the networks of NanoTrack 3: what they answer has other sizes "
                f"({error}); give its backbone and its head."
            ) from error
        self._place: _Place | None = None

    @staticmethod
    def is_head(file: Path) -> bool:
        """Whether a file is the head of version 3, whose scores have a grid of their own."""
        outputs = Network(file).outputs.values()
        return any(len(info.shape) == 4 and info.shape[1:] == (2, _GRID, _GRID) for info in outputs)

    def start(self, image: Image, box: Box) -> None:
        """Take ``box`` ``(x, y, w, h)`` as the object's place in ``image`` ``(H, W, 3)`` RGB."""
        self._place = None
        if (visible := clip_box(box, image.shape)) is None:
            return
        x, y, width, height = visible
        centre = np.array([x + (width - 1) / 2, y + (height - 1) / 2])
        self._place = _Place(centre, np.maximum([width, height], _LEAST_SIDE))
        self._template = np.ascontiguousarray(self._features(image, self._place)[:, :, _INNER, _INNER])

    def update(self, image: Image) -> Box | None:
        """The box in the next image; None before `start`, or if the box was outside the image there."""
        if self._place is None:
            return None
        feeds = (self._template, self._features(image, self._place))
        scores, sides = self._head.run(dict(zip(self._head.inputs, feeds, strict=True))).values()
        self._place = _next_place(self._place, scores[0], sides[0].astype(np.float64), image.shape)
        (x, y), (width, height) = self._place.centre, self._place.size
        return float(x - (width - 1) / 2), float(y - (height - 1) / 2), float(width), float(height)

    def _features(self, image: Image, place: _Place) -> NDArray[np.float32]:
        """``(1, C, 16, 16)`` of the search region around a place."""
        side = place.template_side * _SEARCH / _TEMPLATE
        scale = _SEARCH / side
        shift = (_SEARCH - 1) / 2 - scale * place.centre
        to_crop = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]])
        mean = tuple(float(value) for value in cv2.mean(image)[:3])
        crop = cv2.warpAffine(
            image, to_crop, (_SEARCH, _SEARCH), borderMode=cv2.BORDER_CONSTANT, borderValue=mean
        )
        bgr = np.ascontiguousarray(crop[..., ::-1].transpose(2, 0, 1)[None], np.float32)
        (features,) = self._backbone.run({next(iter(self._backbone.inputs)): bgr}).values()
        return features


def _next_place(
    last: _Place, scores: NDArray[np.float32], sides: NDArray[np.float64], shape: tuple[int, ...]
) -> _Place:
    """The best box of a search region, with its size smoothed.

    Args:
        last: Where the object was; the centre of the region.
        scores: ``(2, S, S)`` logits of background and object.
        sides: ``(4, S, S)`` distances to the left, upper, right and lower side, in pixels of the crop.
        shape: ``(H, W, ...)`` of the frame.
    """
    count = scores.shape[1]
    at = _STRIDE * (np.arange(count) - count // 2)
    left, right, top, bottom = at - sides[0], at + sides[2], at[:, None] - sides[1], at[:, None] + sides[3]
    size = np.maximum(np.stack([right - left, bottom - top]), 1.0)
    scale = _TEMPLATE / last.template_side
    likely = 1 / (1 + np.exp(np.clip(scores[0] - scores[1], -80, 80).astype(np.float64)))
    grown = _ratio(_side_with_context(size) / _side_with_context(last.size * scale))
    turned = _ratio(last.size[0] / last.size[1] * size[1] / size[0])
    penalty = np.exp(-_SHAPE_PENALTY * (grown * turned - 1))
    window = np.outer(np.hanning(count), np.hanning(count))
    row, column = np.unravel_index(
        np.argmax((1 - _WINDOW_WEIGHT) * penalty * likely + _WINDOW_WEIGHT * window), (count, count)
    )
    centre = np.array([left[row, column] + right[row, column], top[row, column] + bottom[row, column]]) / 2
    rate = float(_SIZE_RATE * penalty[row, column] * likely[row, column])
    frame = np.array([shape[1], shape[0]], float)
    mixed = (1 - rate) * last.size + rate * size[:, row, column] / scale
    return _Place(
        np.clip(last.centre + centre / scale, 0, frame),
        np.clip(mixed, _LEAST_SIDE, np.maximum(frame, _LEAST_SIDE)),
    )


def _side_with_context(size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Side of the square of the area of boxes of ``size`` ``(2, ...)`` with context around them."""
    around = _CONTEXT * (size[0] + size[1])
    return np.asarray(np.sqrt((size[0] + around) * (size[1] + around)))


def _ratio(factor: NDArray[np.float64]) -> NDArray[np.float64]:
    """A factor or its inverse, whichever is larger."""
    return np.maximum(factor, 1 / factor)
