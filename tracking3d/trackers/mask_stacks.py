"""Masks in one file: a numpy array, an archive of arrays, or a video."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.trackers.mask_images import UnreadableMaskError, binarize, natural_key


class ArrayMasks:
    """Masks in an ``.npy`` or ``.npz`` file, never unpickled.

    One array ``(N, H, W)`` of all masks, or in an ``.npz`` one array ``(H, W)`` under each frame's name.

    Raises:
        InputError: If the file cannot be read or holds no such arrays.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        try:
            loaded = np.load(path, mmap_mode="r", allow_pickle=False)
            keys = [] if isinstance(loaded, np.ndarray) else sorted(loaded.files, key=natural_key)
            first = loaded[keys[0]] if keys else loaded
            self._arrays: Sequence[NDArray] | NDArray = first[None] if first.ndim == 2 else first
            if len(keys) > 1 or (keys and first.ndim == 2):
                self.names = [Path(key).stem for key in keys]
                self._arrays = _Members(loaded, keys)
            _plane(self._arrays[0])
        except Exception as error:  # zip, header, shape and dtype errors alike
            raise InputError(
                f"{path} holds no masks; store an array (N, H, W) of numbers or booleans, or in an .npz one "
                "array (H, W) under each frame's name."
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
        raise ValueError(f"not a mask: shape {array.shape}, type {array.dtype}")
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
            yield np.asarray(frame.to_ndarray(format="gray"), np.uint8)
