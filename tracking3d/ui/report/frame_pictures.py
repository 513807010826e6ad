"""Images of a run's frames as JPEG, limited in size and number for a page.

They are taken from the overlay video, since the source may be gone. JPEG and not the video itself: a slider then
shows exactly the frame that it names, in any browser, whatever codecs that has.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.results.overlay import OverlaySize
from tracking3d.results.redrawing import overlay_frames
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import report_each

BUDGET = 6_500_000
"""Bytes of all pictures of a page; as text in the page they take a third more."""
WIDEST, NARROWEST = 640, 320
"""Pixels across a picture."""
_QUALITY = 74
_BYTES_A_PIXEL = 0.15  # of a JPEG of that quality, as a first guess


@dataclass(frozen=True, eq=False)
class FramePictures:
    """Pictures of some frames of a run."""

    # which of the run's estimates each picture shows, rising: positions in RunReader.frames
    positions: tuple[int, ...] = ()
    jpegs: tuple[bytes, ...] = ()  # the pictures
    width: int = 0  # pixels across
    height: int = 0  # pixels down

    @property
    def step(self) -> int:
        """How many estimates one picture stands for."""
        return self.positions[1] - self.positions[0] if len(self.positions) > 1 else 1


def frame_pictures(run: RunReader, budget: int = BUDGET) -> FramePictures:
    """The overlay of a run's frames, without its status bar; none if there is no overlay that can be read.

    Frames get smaller if there are many, and if that is not enough, only every n-th is used.

    Args:
        run: The run.
        budget: Bytes of all pictures together.
    """
    size = OverlaySize.of(run.camera)
    count = len(run.frames)
    ratio = size.picture / size.width
    least = _BYTES_A_PIXEL * NARROWEST**2 * ratio
    step = max(math.ceil(count * least / budget), 1)
    room = budget / max(math.ceil(count / step), 1)
    widest = min(WIDEST, size.width)
    width = int(min(max(math.sqrt(room / _BYTES_A_PIXEL / ratio), NARROWEST), widest))
    positions = range(0, count, step)
    overlays = report_each("report", overlay_frames(run, positions), len(positions))
    jpegs = [_encode(image[: size.picture], width) for image in overlays]
    while (total := sum(map(len, jpegs))) > budget and width > NARROWEST // 2:
        width = int(width * min(math.sqrt(budget / total), 0.9))
        jpegs = [_encode(_decode(jpeg), width) for jpeg in jpegs]
    while sum(map(len, jpegs)) > budget:
        jpegs, positions = jpegs[::2], positions[::2]
    shown = tuple(positions[: len(jpegs)])
    return FramePictures(shown, tuple(jpegs), width, _height(width, ratio)) if jpegs else FramePictures()


def jpeg_of(image: NDArray[np.uint8], quality: int = _QUALITY) -> bytes:
    """``(H, W, 3)`` RGB as JPEG."""
    encoded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return encoded.tobytes()


def _encode(image: Image, width: int) -> bytes:
    height, before = image.shape[:2]
    if width != before:
        shape = (width, _height(width, height / before))
        image = cv2.resize(image, shape, interpolation=cv2.INTER_AREA)
    return jpeg_of(image)


def _height(width: int, ratio: float) -> int:
    return max(round(width * ratio), 1)


def _decode(jpeg: bytes) -> Image:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None  # we encoded it
    return image[..., ::-1].astype(np.uint8)
