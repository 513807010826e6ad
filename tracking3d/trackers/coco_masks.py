"""Masks in COCO's JSON: run-length encoded, compressed or not, or polygons. https://cocodataset.org/#format-data"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.trackers.mask_images import UnreadableMaskError, natural_key, of_objects

_LONGEST = 1 << 30
_MOST_PIXELS = 2**28
_SAME_OBJECT = ("track_id", "instance_id", "object_id", "category_id")
"""Keys that identify the objects of a video, by preference; COCO itself has only categories."""


class CocoMasks:
    """One object's masks out of a COCO file; the pieces of one object in one image are one mask.

    A list of results (``image_id``, ``category_id``, ``segmentation``) is read as well as a whole data set. Images are
    called by their file names, or by their numbers if they have none.

    Args:
        path: The file.
        object: Number of the object by `_SAME_OBJECT`; None if there is one only.

    Raises:
        InputError: If the file cannot be read as COCO, holds no such object, or several and none is chosen.
    """

    def __init__(self, path: Path, object: int | None = None) -> None:
        self._path = path
        images, annotations = _read(path)
        key = next((key for key in _SAME_OBJECT if any(key in one for one in annotations)), None)
        numbers = {one.get(key) for one in annotations} if key else set()
        chosen = of_objects(numbers - {None}, object, path)
        self._segmentations: dict[Any, list[Any]] = {number: [] for number in images}
        for one in annotations:
            if (key is None or one.get(key) == chosen) and one.get("image_id") in images:
                self._segmentations[one["image_id"]].append(one.get("segmentation"))
        names = {number: Path(str(image.get("file_name", number))).stem for number, image in images.items()}
        self._order = sorted(images, key=lambda number: natural_key(names[number]))
        self._sizes = {number: _size(image) for number, image in images.items()}
        self.names: Sequence[str] = [names[number] for number in self._order]

    def label(self, position: int) -> str:
        """The file's path and the image."""
        return f"{self._path} [{self.names[position]}]"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`; an image without the object has an empty mask."""
        number = self._order[position]
        size = self._sizes[number]
        mask = None if size is None else np.zeros(size, bool)
        for segmentation in self._segmentations[number]:
            try:
                piece = decode(segmentation, size)
                mask = piece if mask is None else mask | piece
            except (
                TypeError,
                ValueError,
                KeyError,
                IndexError,
                OverflowError,
                AttributeError,
                cv2.error,
            ) as error:
                raise UnreadableMaskError(f"{self.label(position)} cannot be read") from error
        return mask


def decode(segmentation: Any, size: tuple[int, int] | None) -> NDArray[np.bool_]:
    """A segmentation as ``(H, W)``.

    Args:
        segmentation: ``{"size": [H, W], "counts": runs or text}``, or polygons ``[[x, y, ...], ...]``.
        size: ``(H, W)`` of the image, which polygons do not tell.

    Raises:
        ValueError: If it is none of them, or the run lengths do not fill the image.
    """
    if isinstance(segmentation, list):
        if size is None:
            raise ValueError("a polygon without the size of its image")
        canvas = np.zeros(size, np.uint8)
        # COCO counts from the outer corner of the first pixel.
        corners = [
            np.round(np.asarray(one, float).reshape(-1, 2) - 0.5).astype(np.int32) for one in segmentation
        ]
        return cv2.fillPoly(canvas, corners, 1).astype(bool)
    height, width = (int(side) for side in segmentation["size"])
    counts = segmentation["counts"]
    runs = np.array(decompress(counts) if isinstance(counts, str | bytes) else counts, dtype=np.int64)
    pixels = height * width
    if min(height, width) <= 0 or pixels > _MOST_PIXELS or (runs < 0).any() or runs.sum() != pixels:
        raise ValueError("the run lengths do not fill the image")
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def decompress(text: str | bytes) -> list[int]:
    """COCO's compressed runs: five bits a sign, differences from the third run on (cocoapi, ``maskApi.c``).

    Raises:
        ValueError: If a sign is none of theirs, or the text ends within a number.
    """
    data = text.encode("ascii") if isinstance(text, str) else text
    runs: list[int] = []
    value = shift = 0
    for sign in data:
        bits = sign - 48
        if not 0 <= bits < 64 or shift > 60:
            raise ValueError("it is not a run-length encoding")
        value |= (bits & 31) << shift
        shift += 5
        if bits & 32:
            continue
        if bits & 16:
            value -= 1 << shift
        runs.append(value + (runs[-2] if len(runs) > 2 else 0))
        value = shift = 0
    if shift:
        raise ValueError("the run-length encoding is truncated")
    return runs


def _read(path: Path) -> tuple[dict[Any, Mapping[str, Any]], list[Mapping[str, Any]]]:
    """Images by their number, and annotations."""
    wanted = "give COCO images and annotations, or a list of COCO results"
    try:
        if path.stat().st_size > _LONGEST:
            raise InputError(f"{path} is larger than {_LONGEST >> 30} GiB, too large for one object's masks.")
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"The masks {path} cannot be read as JSON; {wanted}.") from error
    if isinstance(content, list):
        results = [one for one in content if isinstance(one, dict) and "image_id" in one]
        content = {"images": [{"id": one["image_id"]} for one in results], "annotations": results}
    images = content.get("images") if isinstance(content, dict) else None
    annotations = content.get("annotations") if isinstance(content, dict) else None
    if not isinstance(images, list) or not isinstance(annotations, list) or not images:
        raise InputError(f"{path} holds no COCO masks; {wanted}.")
    known: dict[Any, Mapping[str, Any]] = {
        one["id"]: one for one in images if isinstance(one, dict) and isinstance(one.get("id"), int | str)
    }
    usable: list[Mapping[str, Any]] = [
        one for one in annotations if isinstance(one, dict) and isinstance(one.get("image_id"), int | str)
    ]
    if not known:
        raise InputError(f"{path} holds no images with an id; {wanted}.")
    return known, usable


def _size(image: Mapping[str, Any]) -> tuple[int, int] | None:
    height, width = image.get("height"), image.get("width")
    if not (isinstance(height, int) and isinstance(width, int)):
        return None
    return (height, width) if min(height, width) > 0 and height * width <= _MOST_PIXELS else None
