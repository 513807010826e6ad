"""Box trackers that propose where the object is: CSR-DCF, or the networks NanoTrack and VitTrack."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, PluginError
from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.csrt import BoxTracker, CsrtTracker
from tracking3d.trackers.onnx.images import TRIAL_BOX, TRIAL_IMAGE
from tracking3d.trackers.opencv_build import why_no_contrib

_LEAST_SIDE = 4  # pixels that a box tracker needs


class BoxProposer(Protocol):
    """Follows a box; may be started again at any frame."""

    def start(self, image: Image, box: Box) -> None:
        """Take ``box`` ``(x, y, w, h)`` as the object's place in ``image`` ``(H, W, 3)`` RGB."""
        ...

    def update(self, image: Image) -> Box | None:
        """The box in the next image, or None if the object is lost."""
        ...


class CsrtBoxes:
    """OpenCV's CSR-DCF.

    Raises:
        PluginError: If the OpenCV in use lacks it.
    """

    def __init__(self, options: CsrtTracker.Options) -> None:
        if why := why_no_contrib("TrackerCSRT"):
            raise PluginError(f"The box tracker csrt cannot be used: {why}.")
        self._options = options
        self._tracker: BoxTracker | None = None

    def start(self, image: Image, box: Box) -> None:
        """See `BoxProposer.start`."""
        self._tracker = BoxTracker(self._options, image, box)

    def update(self, image: Image) -> Box | None:
        """See `BoxProposer.update`."""
        return None if self._tracker is None else self._tracker.update(image)


class NetworkBoxes:
    """A tracker of OpenCV that runs on networks: ``cv2.TrackerNano`` or ``cv2.TrackerVit``.

    Args:
        kind: Which of them.
        files: Its ONNX files.

    Raises:
        InputError: If a file is no network that OpenCV can run, or it cannot track by it.
    """

    def __init__(self, kind: Any, *files: Path) -> None:
        # Networks are read first: given by name in Params, OpenCV would print warnings about its own defaults.
        self._tracker = kind.create(*(_read_output(file) for file in files))
        self._started = False
        try:
            self._tracker.init(TRIAL_IMAGE, TRIAL_BOX)
            self._tracker.update(TRIAL_IMAGE)
        except cv2.error as error:
            raise InputError(
                f"OpenCV's {kind.__name__} cannot track by {' and '.join(map(str, files))} ({error.err}); give the "
                "files that were exported for it."
            ) from error

    def start(self, image: Image, box: Box) -> None:
        """See `BoxProposer.start`."""
        self._started = False
        if (rectangle := _rectangle(box, image.shape)) is None:
            return
        try:
            self._tracker.init(_bgr(image), rectangle)
            self._started = True
        except cv2.error:  # the image is too small for its search region
            pass

    def update(self, image: Image) -> Box | None:
        """See `BoxProposer.update`."""
        if not self._started:
            return None
        try:
            found, box = self._tracker.update(_bgr(image))
        except cv2.error:  # the search region has left the image
            return None
        x, y, width, height = (float(value) for value in box)
        return (x, y, width, height) if found and min(width, height) > 0 else None


def nano_boxes(backbone: Path, head: Path, threads: int = 1) -> BoxProposer:
    """NanoTrack from its two ONNX files; their sizes tell its version.

    Args:
        backbone: The file of the backbone.
        head: The file of the head; of versions 1 and 2 it is run by OpenCV, which rejects that of version 3.
        threads: CPU threads of version 3.

    Raises:
        InputError: If a file is no such network.
    """
    if not SiameseBoxes.is_head(head):
        return NetworkBoxes(cv2.TrackerNano, backbone, head)
    return SiameseBoxes(backbone, head, threads)


def vit_boxes(model: Path) -> NetworkBoxes:
    """VitTrack from its ONNX file.

    Raises:
        InputError: If the file is no network that OpenCV can run.
    """
    return NetworkBoxes(cv2.TrackerVit, model)


def _read_output(file: Path) -> Any:
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        # By its bytes: OpenCV ends the process if a path is not UTF-8.
        return cv2.dnn.readNetFromONNX(np.frombuffer(file.read_bytes(), np.uint8))
    except cv2.error as error:
        raise InputError(
            f"{file} is not a network that OpenCV can run; give an ONNX file exported for OpenCV's tracker."
        ) from error
    finally:
        cv2.utils.logging.setLogLevel(level)


def _rectangle(box: Box, shape: tuple[int, ...]) -> list[int] | None:
    """Whole pixels inside the frame; a smaller box is grown about its corner. None if nothing is left."""
    visible = clip_box(box, shape)
    if visible is None:
        return None
    x, y, width, height = visible
    width, height = max(round(width), _LEAST_SIDE), max(round(height), _LEAST_SIDE)
    return [max(min(int(x), shape[1] - width), 0), max(min(int(y), shape[0] - height), 0), width, height]


def _bgr(image: Image) -> NDArray[np.uint8]:
    return cv2.cvtColor(image, cv2.COLOR_RGB2BGR)


# The box tracker NanoTrack on onnxruntime: a Siamese network compares a template with the region around the last box.
#
# Its third version has a head that ``cv2.TrackerNano`` rejects. The method and its constants are those of
# https://github.com/HonglinChu/SiamTrackers (NanoTrack, ``configv3.yaml``), after SiamBAN (Chen et al., CVPR 2020).

_TEMPLATE, _SEARCH = 127, 255  # pixels: sides of the template and of the search region
_STRIDE = 16
_GRID = 15  # of the scores
_INNER = slice(4, 12)  # the template's part of a search region's features, which are 16 x 16
_CONTEXT = 0.5  # of the mean of the box's sides, around the box
_WINDOW_WEIGHT, _SHAPE_PENALTY, _SIZE_RATE = 0.455, 0.138, 0.348
_LEAST_CROP_SIDE = 10.0  # pixels of a box


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
        self._place = _Place(centre, np.maximum([width, height], _LEAST_CROP_SIDE))
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
        np.clip(mixed, _LEAST_CROP_SIDE, np.maximum(frame, _LEAST_CROP_SIDE)),
    )


def _side_with_context(size: NDArray[np.float64]) -> NDArray[np.float64]:
    """Side of the square of the area of boxes of ``size`` ``(2, ...)`` with context around them."""
    around = _CONTEXT * (size[0] + size[1])
    return np.asarray(np.sqrt((size[0] + around) * (size[1] + around)))


def _ratio(factor: NDArray[np.float64]) -> NDArray[np.float64]:
    """A factor or its inverse, whichever is larger."""
    return np.maximum(factor, 1 / factor)
