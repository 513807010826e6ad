"""Box trackers that propose where the object is: CSR-DCF, or the networks NanoTrack and VitTrack."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Box, Image
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.csrt import BoxTracker, CsrtTracker
from tracking3d.trackers.onnx.images import TRIAL_BOX, TRIAL_IMAGE
from tracking3d.trackers.onnx.siamese_boxes import SiameseBoxes
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
