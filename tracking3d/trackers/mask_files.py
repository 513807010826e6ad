"""Masks on disk in any supported form: opened cheaply, decoded one at a time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.runtime.array_files import ArrayFile, ArrayHeader, ArrayTooLargeError
from tracking3d.trackers.mask_images import (
    ImageMasks,
    UnreadableMaskError,
    binarize,
    is_cut_out,
    natural_key,
    of_objects,
)
from tracking3d.trackers.vot_regions import RegionMasks

__all__ = ["ImageMasks", "MaskFiles", "UnreadableMaskError", "natural_key", "open_masks"]

# fmt: off
_SUFFIXES = frozenset((
    ".avif", ".bmp", ".gif", ".jp2", ".jpeg", ".jpg", ".pbm",
    ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp",
))
# fmt: on
_PROBES = 24  # images that are read to know whether a folder holds cut-outs (chosen)


class MaskFiles(Protocol):
    """Masks in their natural order."""

    # what each mask is called, without folder and suffix; empty if masks are only in order
    names: Sequence[str]

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """Mask ``position`` as ``(H, W)`` bool, None beyond the last. Raises `UnreadableMaskError`."""
        ...

    def label(self, position: int) -> str:
        """What messages call mask ``position``."""
        ...


def open_masks(path: Path, object: int | None = None) -> MaskFiles:
    """Open a folder of images, a single image, an ``.npy`` or ``.npz`` file, or a video of masks.

    The results of other tools too: the folders of DAVIS and YouTube-VOS (one video), COCO's JSON, VOT's text.

    Args:
        path: What the user gave.
        object: Which object, if there are several: its palette index, or its number in COCO's file.

    Raises:
        InputError: If there is nothing at ``path``, no mask in it, or several objects of which none is chosen.
    """
    if not path.exists():
        raise InputError(
            f"{path} holds no masks; give a folder, a video, an .npz or an .npy file, COCO's .json or "
            "VOT's .txt."
        )
    if path.is_dir():
        folder = _of_one_video(path)
        return ImageMasks(folder, [file for file in folder.iterdir() if _is_image(file)], object)
    if _is_image(path):
        return ImageMasks(path, [path], object)
    suffix = path.suffix.lower()
    if suffix == ".json":
        return CocoMasks(path, object)
    if object is not None:
        raise InputError(f"{path} holds masks of one object; leave out the object number ({object}).")
    if suffix == ".txt":
        return RegionMasks(path)
    return ArrayMasks(path) if suffix in (".npy", ".npz") else VideoMasks(path)


def holds_cut_outs(source: str) -> bool:
    """Whether a folder's images have alpha that says where the object is; `_PROBES` of them are read."""
    folder = Path(source)
    files = sorted(filter(_is_image, folder.iterdir())) if folder.is_dir() else []
    return bool(files) and all(is_cut_out(files[place * len(files) // _PROBES]) for place in range(_PROBES))


def _of_one_video(path: Path) -> Path:
    """The folder of images that is meant by that of a data set.

    Raises:
        InputError: If it is of several videos.
    """
    inner = path / "Annotations" if (path / "Annotations").is_dir() else path
    if any(map(_is_image, inner.iterdir())):
        return inner
    folders = sorted(
        folder for folder in inner.iterdir() if folder.is_dir() and any(map(_is_image, folder.iterdir()))
    )
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders[:4])
        raise InputError(
            f"{path} has masks of several videos ({names}...); give the folder of one: {folders[0]}."
        )
    return folders[0] if folders else path


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".") and path.is_file()


MOST_PIXELS = 2**27
"""Pixels that a plane may have, several times those of the largest video."""


class Planes(Protocol):
    """Planes by position."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def header(self, position: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """Shape and type of a plane."""
        ...

    def read(self, position: int) -> NDArray[Any]:
        """A plane."""
        ...


def read_plane(planes: Planes, position: int) -> NDArray[Any]:
    """A plane ``(H, W)`` of numbers or bool; a side of length 1 in front of it or behind it is taken off.

    Raises:
        ArrayTooLargeError: If it has more than `MOST_PIXELS`.
        ValueError: If it is no such plane.
    """
    shape, dtype = planes.header(position)
    single = [axis for axis in (0, -1) if len(shape) == 3 and shape[axis] == 1][:1]
    sides = len(shape) - len(single)
    if sides != 2 or not math.prod(shape) or dtype.kind not in "biuf":
        raise ValueError(f"not a mask: shape {shape}, type {dtype}")
    if math.prod(shape) > MOST_PIXELS:
        raise ArrayTooLargeError(f"one has {' x '.join(map(str, shape))} pixels")
    return np.squeeze(planes.read(position), axis=tuple(single))


class MappedPlanes:
    """Those of an ``.npy`` file, mapped into memory.

    Args:
        path: The file.

    Raises:
        ValueError: If it is none, or would have to be unpickled.
    """

    def __init__(self, path: Path) -> None:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        self._array: NDArray[Any] = array[None] if array.ndim == 2 else array

    def __len__(self) -> int:
        return len(self._array)

    def header(self, position: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """See `Planes.header`."""
        return self._array.shape[1:], self._array.dtype

    def read(self, position: int) -> NDArray[Any]:
        """See `Planes.read`."""
        plane: NDArray[Any] = self._array[position]
        return plane


class NamedPlanes:
    """The arrays of an ``.npz`` file.

    Args:
        archive: The file.
        names: Their names, in order.
    """

    def __init__(self, archive: ArrayFile, names: list[str]) -> None:
        self._archive, self._names = archive, names

    def __len__(self) -> int:
        return len(self._names)

    def header(self, position: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """See `Planes.header`."""
        header = self._archive.header(self._names[position])
        return header.shape, header.dtype

    def read(self, position: int) -> NDArray[Any]:
        """See `Planes.read`."""
        return self._archive.read(self._names[position])


class StackedPlanes:
    """The planes of one array of an ``.npz`` file, decompressed forward as they are asked for.

    Args:
        archive: The file.
        name: The array.

    Raises:
        ValueError: If it is damaged, or so stored that it must be read as a whole, and too large for that.
    """

    def __init__(self, archive: ArrayFile, name: str) -> None:
        self._header: ArrayHeader = archive.header(name)
        self._whole = archive.read(name) if self._header.columns_first else None
        self._stream = archive.open(name)

    def __len__(self) -> int:
        return self._header.shape[0]

    def header(self, position: int) -> tuple[tuple[int, ...], np.dtype[Any]]:
        """See `Planes.header`."""
        return self._header.shape[1:], self._header.dtype

    def read(self, position: int) -> NDArray[Any]:
        """See `Planes.read`; going back decompresses again from the start."""
        if self._whole is not None:
            plane: NDArray[Any] = self._whole[position]
            return plane
        shape, dtype = self.header(position)
        length = math.prod(shape) * dtype.itemsize
        self._stream.seek(self._header.offset + position * length)
        return np.frombuffer(self._stream.read(length), dtype).reshape(shape)


class ArrayMasks:
    """Masks in an ``.npy`` or ``.npz`` file, never unpickled, each read when it is asked for.

    One array ``(N, H, W)`` of all masks, or in an ``.npz`` one array ``(H, W)`` under each frame's name.

    Raises:
        InputError: If the file cannot be read, holds no such arrays, or a mask is larger than a frame can be.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        try:
            self._arrays = self._open()
            read_plane(self._arrays, 0)
        except ArrayTooLargeError as error:
            raise InputError(
                f"{path} holds masks that are larger than a frame can be ({error}); give masks of the frames' size."
            ) from error
        except Exception as error:  # zip, header, shape and dtype errors alike
            raise InputError(
                f"{path} holds no masks; store an array (N, H, W) of numbers or booleans, or in an .npz one "
                "array (H, W) under each frame's name."
            ) from error

    def _open(self) -> Planes:
        with self._path.open("rb") as file:
            if file.read(4) != b"PK\x03\x04":
                return MappedPlanes(self._path)
        archive = ArrayFile(self._path)
        names = sorted(archive.names, key=natural_key)
        if len(names) == 1 and len(archive.header(names[0]).shape) > 2:
            return StackedPlanes(archive, names[0])
        self.names = [Path(name).stem for name in names]
        return NamedPlanes(archive, names)

    def label(self, position: int) -> str:
        """The file's path and the array's name or number."""
        return f"{self._path} [{self.names[position] if self.names else position}]"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`."""
        if position >= len(self._arrays):
            return None
        try:
            return binarize(read_plane(self._arrays, position))
        except ArrayTooLargeError as error:
            raise UnreadableMaskError(
                f"{self.label(position)} is larger than a frame can be ({error})"
            ) from error
        except Exception as error:  # a damaged member of the archive, or one of another shape
            raise UnreadableMaskError(f"{self.label(position)} cannot be read") from error


class VideoMasks:
    """A video whose frames are the masks, decoded forward as they are asked for.

    Raises:
        InputError: If the file is no video.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        self._restart()
        try:
            self._advance()
        except Exception as error:  # av raises many kinds
            raise InputError(
                f"{path} cannot be read as masks; give a folder of images, a video, an .npz or an .npy file."
            ) from error
        if self._mask is None:
            raise InputError(f"The video {path} has no frame that can be read as a mask.")

    def label(self, position: int) -> str:
        """The file's path and the frame's number."""
        return f"{self._path} [{position}]"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`; going back decodes again from the start."""
        if position < self._position:
            self._restart()
        try:
            while self._position < position and self._mask is not None:
                self._advance()
        except av.FFmpegError as error:
            raise UnreadableMaskError(f"{self.label(position)} cannot be decoded") from error
        return self._mask

    def _restart(self) -> None:
        self._frames = _grey_frames(self._path)
        self._position = -1
        self._mask: NDArray[np.bool_] | None = np.zeros((1, 1), bool)

    def _advance(self) -> None:
        grey = next(self._frames, None)
        self._position += 1
        self._mask = None if grey is None else grey > 127


def _grey_frames(path: Path) -> Iterator[NDArray[np.uint8]]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield np.asarray(frame.to_ndarray(format="gray"), np.uint8)


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
