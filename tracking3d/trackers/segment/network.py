"""The segmentation network of the package: which pixels of a crop are the object that a box or the last mask shows.

1.2 million parameters, distilled from MobileSAM on freely licensed photographs and on scenes composed of them;
``training/segmentation`` has the training, and what each input channel means.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.features.networks.session import Network
from tracking3d.frames import Box, Image
from tracking3d.geometry.camera import Window
from tracking3d.scene.view import FrameCrop, crop_window
from tracking3d.trackers.colour_models import GlobalColours
from tracking3d.trackers.crops import box_of, clip_box

Map = NDArray[np.float32]
"""``(S, S)`` of a square crop."""

SIZE = 160
"""Side of the network's crops in pixels."""

_CHANNELS = 8
_MASK, _COLOURS, _MOTION, _IS_BOX, _HAS_COLOURS = range(3, _CHANNELS)
_MARGIN = 0.2  # free space around the box, as in training
_COLOUR_SCALE, _MOTION_SCALE = 3.0, 2.0  # divisors of the log-odds of colours and of the motion cue
_MOST = 4.0  # log-odds; beyond its crop there is no object
_FIRST_MARGINS = (0.125, 0.2, 0.3)  # those of a first frame, or a photo, in which time does not matter


_CLOSE = np.ones((5, 5), np.uint8)
"""Between the outlines of the mask and of what hides a part of it, two pixels may be left."""


class ObjectNetwork:
    """Runs the network of the package on crops of a video's frames; deterministic.

    Args:
        threads: CPU threads.
    """

    def __init__(self, threads: int = 1) -> None:
        with resources.as_file(
            resources.files("tracking3d.trackers") / "weights" / "segmentation.onnx"
        ) as own:
            self._network = Network(Path(own), threads)

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Itself: a copy of what uses the network shares it."""
        return self

    def segment_box(
        self, image: Image, box: Box, margins: tuple[float, ...] = _FIRST_MARGINS
    ) -> tuple[Map, Map]:
        """The object in a box, and what is in front of it, by nothing but one image.

        Every crop is seen twice, the second time mirrored.

        Args:
            image: ``(H, W, 3)`` RGB.
            box: ``(x, y, w, h)`` in pixels, at least partly in the image.
            margins: Free space around the box in each crop, in its longer side.

        Returns:
            ``(H, W)`` in [0, 1] each: the probability of the object and of an occluder, 0 beyond the crops.
        """
        visible = clip_box(box, image.shape) or box
        windows = [Window.around(visible, margin, SIZE) for margin in margins]
        crops = np.stack([_box_channels(FrameCrop.of(image, window), box) for window in windows])
        logits = self._run(np.concatenate([crops, crops[..., ::-1]]))
        mean = (logits[: len(windows)] + logits[len(windows) :, ..., ::-1]) / 2
        full = np.zeros((2, *image.shape[:2]), np.float32)
        for window, maps in zip(windows, mean, strict=True):
            full += np.stack([_paste_logits(one, window, image.shape) for one in maps]) / len(windows)
        return _probability(full[0]), _probability(full[1])

    def log_odds(
        self,
        image: Image,
        carried: Map,
        motion: Map,
        window: Window,
        colours: GlobalColours,
        box: Box,
    ) -> tuple[Map, Map, Map]:
        """The object in a crop by its last mask, and by a box; and what is in front of it.

        Args:
            image: ``(H, W, 3)`` RGB, the present frame.
            carried: ``(S, S)`` in [0, 1], where the last mask has moved in the crop.
            motion: ``(S, S)``, the motion cue there.
            window: The crop.
            colours: The colours of the object and of its surroundings.
            box: ``(x, y, w, h)`` in the frame, the other prompt.

        Returns:
            ``(S, S)`` log-odds within [-4, 4]: the object by the mask, with colours and motion, and by the box; an
            occluder by both.
        """
        around = frame_box(carried, window)
        if around is None:
            nothing = np.full_like(carried, -_MOST)
            return nothing, nothing, nothing
        crops = [
            FrameCrop.of(image, Window.around(clip_box(one, image.shape) or one, _MARGIN, SIZE))
            for one in (around, box)
        ]
        channels = [_image_channels(crops[0]), _box_channels(crops[1], box)]
        by_mask = crops[0].window
        channels[0][_MASK] = _resample(carried, window, by_mask)
        channels[0][_COLOURS] = colours.log_ratio(crops[0].lab) / _COLOUR_SCALE
        channels[0][_MOTION] = _resample(motion, window, by_mask) / _MOTION_SCALE
        channels[0][_HAS_COLOURS] = 1
        objects, occluders = (
            [
                np.clip(_resample(one, crop.window, window, -2 * _MOST), -_MOST, _MOST)
                for one, crop in zip(maps, crops, strict=True)
            ]
            for maps in self._run(np.stack(channels)).swapaxes(0, 1)
        )
        return objects[0], objects[1], np.asarray((occluders[0] + occluders[1]) / 2, np.float32)

    def occluder(self, image: Image, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """What is in front of an object or beside it, such as a hand, by one image and the object's mask.

        Args:
            image: ``(H, W, 3)`` RGB.
            mask: ``(H, W)``, the object; not empty.

        Returns:
            ``(H, W)``, without the object.
        """
        box = box_of(mask)
        if box is None:
            return np.zeros_like(mask)
        window = Window.around(box, _MARGIN, SIZE)
        crop = FrameCrop.of(image, window)
        by_mask, by_box = _image_channels(crop), _box_channels(crop, box)
        by_mask[_MASK] = crop_window(mask.astype(np.float32), window)
        logits = self._run(np.stack([by_mask, by_box]))[:, 1].mean(0)
        return beside_mask(_paste_logits(logits, window, image.shape) > 0, mask)

    def _run(self, crops: NDArray[np.float32]) -> NDArray[np.float32]:
        """``(B, 8, S, S)`` to logits ``(B, 2, S, S)``: the visible object, and what is in front of it."""
        return self._network.run({"crop": np.ascontiguousarray(crops)})["logits"]


def beside_mask(occluder: NDArray[np.bool_], mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(H, W)``: what the mask takes is the object, and what is close beside an occluder belongs to that."""
    return (cv2.dilate(occluder.astype(np.uint8), _CLOSE) > 0) & ~mask


def _image_channels(crop: FrameCrop) -> NDArray[np.float32]:
    channels = np.zeros((_CHANNELS, SIZE, SIZE), np.float32)
    channels[:3] = crop.image.transpose(2, 0, 1).astype(np.float32) / 255 - 0.5
    return channels


def _box_channels(crop: FrameCrop, box: Box) -> NDArray[np.float32]:
    """``(8, S, S)``: the crop, and the box ``(x, y, w, h)`` of the frame, filled."""
    channels = _image_channels(crop)
    window = crop.window
    left, top = (box[0] - window.left) * window.scale, (box[1] - window.top) * window.scale
    right, bottom = left + box[2] * window.scale, top + box[3] * window.scale
    columns, rows = (
        slice(max(round(first), 0), max(round(last), 0)) for first, last in ((left, right), (top, bottom))
    )
    channels[_MASK, rows, columns] = 1
    channels[_IS_BOX] = 1
    return channels


def frame_box(mask: Map, window: Window) -> Box | None:
    """The box ``(x, y, w, h)``, in the frame, of a mask in a window; None if that is empty."""
    if (box := box_of(mask)) is None:
        return None
    x, y, width, height = (value / window.scale for value in box)
    return window.left + x, window.top + y, width, height


def _resample(values: Map, source: Window, target: Window, beyond: float = 0.0) -> Map:
    """What ``target`` sees of the values in ``source``, ``beyond`` outside of it."""
    to_source = np.linalg.inv(source.to_frame) @ target.to_frame
    size = (target.size, target.size)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(
        np.asarray(values, np.float32), to_source[:2], size, flags=flags, borderMode=cv2.BORDER_CONSTANT,
        borderValue=beyond,
    )  # fmt: skip
    return np.asarray(seen, np.float32)


def _paste_logits(logits: Map, window: Window, shape: tuple[int, ...]) -> Map:
    """``(H, W)``: a window's logits in a frame, very low beyond it."""
    full = np.full(shape[:2], -8.0 * _MOST, np.float32)
    region = cv2.resize(logits, (window.side, window.side), interpolation=cv2.INTER_LINEAR)
    rows, columns = (
        slice(max(first, 0), max(min(first + window.side, size), 0))
        for first, size in ((window.top, shape[0]), (window.left, shape[1]))
    )
    part = full[rows, columns]
    part[:] = region[rows.start - window.top :, columns.start - window.left :][
        : part.shape[0], : part.shape[1]
    ]
    return full


def _probability(logits: Map) -> Map:
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -60, 60))), np.float32)
