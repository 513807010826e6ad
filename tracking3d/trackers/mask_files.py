"""Masks on disk: a folder of images, a video, or numpy arrays, opened cheaply and decoded one at a time."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.errors import InputError

_SUFFIXES = frozenset(".avif .bmp .gif .jp2 .jpeg .jpg .pbm .pgm .png .ppm .tif .tiff .webp".split())


class UnreadableMaskError(Exception):
    """One mask of many cannot be decoded; its frame is a gap."""


class MaskFiles(Protocol):
    """Masks in their natural order.

    Attributes:
        names: What each mask is called, without folder and suffix; empty where masks are only in order.
    """

    names: Sequence[str]

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """Mask ``position`` as ``(H, W)`` bool, None beyond the last. Raises `UnreadableMaskError`."""
        ...

    def label(self, position: int) -> str:
        """What messages call mask ``position``."""
        ...


def open_masks(path: Path) -> MaskFiles:
    """Open a folder of images, a single image, an ``.npy`` or ``.npz`` file, or a video of masks.

    Raises:
        InputError: If there is nothing at ``path``, or no mask in it.
    """
    if not path.exists():
        raise InputError(f"There are no masks at {path}; give a folder, a video, an .npz or an .npy file.")
    if path.is_dir():
        return ImageMasks(path, [file for file in path.iterdir() if _is_image(file)])
    if _is_image(path):
        return ImageMasks(path, [path])
    return ArrayMasks(path) if path.suffix.lower() in (".npy", ".npz") else VideoMasks(path)


def natural_key(name: str) -> tuple[str | int, ...]:
    """A key that compares the numbers in a name as numbers: ``frame9`` before ``frame10``, ``7`` equal to ``007``."""
    return tuple(int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name))


def binarize(values: NDArray) -> NDArray[np.bool_]:
    """Object where a value is above half its type's range; where none is, wherever it is above zero.

    So masks of 0 and 255 lose what a lossy codec left in between, and masks of 0 and 1 or of small labels work
    too. Floats range from 0 to 1.

    Args:
        values: ``(H, W)`` bool, integers or floats.
    """
    if values.dtype == np.bool_:
        return values
    bright = values > (np.iinfo(values.dtype).max / 2 if values.dtype.kind in "iu" else 0.5)
    return bright if bright.any() else values > 0


class ImageMasks:
    """One image file a mask: any depth, grey, colour (brightest channel), palette (not black), alpha (where used).

    Args:
        path: What the user gave.
        files: The image files, in any order.

    Raises:
        InputError: If none of the files is a readable image.
    """

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self._files = sorted(files, key=lambda file: natural_key(file.name))
        self.names = [file.stem for file in self._files]
        if not any(self.shape(position) for position in range(len(files))):
            raise InputError(
                f"No image in {path} can be read as a mask; put one mask a frame there, as PNG for example."
            )

    def label(self, position: int) -> str:
        """The file's path."""
        return str(self._files[position])

    def shape(self, position: int) -> tuple[int, int] | None:
        """``(H, W)`` by the file's header alone, or None where it cannot be read."""
        try:
            with warnings.catch_warnings(action="ignore"), Pillow.open(self._files[position]) as image:
                return image.height, image.width
        except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError):
            return None

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`."""
        if position >= len(self._files):
            return None
        try:
            with warnings.catch_warnings(action="ignore"), Pillow.open(self._files[position]) as image:
                return _object_in(image)
        except Exception as error:  # decoders raise whatever a damaged file leads them to
            raise UnreadableMaskError(f"{self._files[position]} cannot be read") from error


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".") and path.is_file()


def _object_in(image: Pillow.Image) -> NDArray[np.bool_]:
    if image.has_transparency_data and image.mode != "P":
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
        if alpha.min() != alpha.max():  # a cut-out; an alpha channel of one value says nothing
            return alpha > 127
    if image.mode == "P":
        return np.asarray(image.convert("RGB")).any(axis=2)
    if image.mode == "I":  # 32-bit integers are how Pillow holds some 16-bit files
        return binarize(np.asarray(image).clip(0, 65535).astype(np.uint16))
    if image.mode in ("1", "L", "F") or image.mode.startswith("I;16"):
        return binarize(np.asarray(image))
    return binarize(np.asarray(image.convert("RGB")).max(axis=2))


class ArrayMasks:
    """Masks in an ``.npy`` or ``.npz`` file: one array ``(N, H, W)``, or in ``.npz`` one ``(H, W)`` a frame name.

    Nothing is unpickled.

    Raises:
        InputError: If the file cannot be read or holds no such arrays.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        try:
            loaded = np.load(path, mmap_mode="r", allow_pickle=False)
            keys = [] if isinstance(loaded, np.ndarray) else sorted(loaded.files, key=natural_key)
            first = loaded if isinstance(loaded, np.ndarray) else loaded[keys[0]]
            self._arrays: Sequence[NDArray] = [_plane(first)] if first.ndim == 2 else first
            if len(keys) > 1:
                self.names = [Path(key).stem for key in keys]
                self._arrays = _Members(loaded, keys)
            _plane(self._arrays[0])
        except Exception as error:  # zip, header, shape and dtype errors alike
            raise InputError(
                f"{path} holds no masks; store an array (N, H, W) of numbers or booleans, or in an .npz one array "
                "(H, W) under each frame's name."
            ) from error

    def label(self, position: int) -> str:
        """The file's path and the array's name or number."""
        return f"{self._path} [{self.names[position] if self.names else position}]"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`."""
        if position >= len(self._arrays):
            return None
        try:
            return binarize(_plane(self._arrays[position]))
        except Exception as error:  # a damaged member of the archive, or one of another shape
            raise UnreadableMaskError(f"{self.label(position)} cannot be read") from error


class _Members(Sequence[NDArray]):
    """The arrays of an open ``.npz`` file by position, each read when asked for."""

    def __init__(self, archive: Mapping[str, NDArray], keys: list[str]) -> None:
        self._archive, self._keys = archive, keys

    def __len__(self) -> int:
        return len(self._keys)

    def __getitem__(self, position):  # type: ignore[no-untyped-def]
        return self._archive[self._keys[position]]


def _plane(array: NDArray) -> NDArray:
    plane = np.squeeze(array, axis=tuple(a for a in (0, -1) if array.ndim == 3 and array.shape[a] == 1)[:1])
    if plane.ndim != 2 or not plane.size or plane.dtype.kind not in "biuf":
        raise ValueError(f"no mask: shape {array.shape}, type {array.dtype}")
    return plane


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
            yield frame.to_ndarray(format="gray")
