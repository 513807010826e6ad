"""The planes ``(H, W)`` of numpy's files one at a time, whatever the size of the whole."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tracking3d.runtime.array_files import ArrayFile, ArrayHeader, ArrayTooLargeError

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
