"""numpy's ``.npz`` files, asked how large an array is before it is read: 4 MB on disk may be 4 GB of memory."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

LARGEST = 2**30
"""Bytes of one array that are read if nothing is known about its size."""

_PLAIN = "biufSU"
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those of numpy; others cannot be read piece by piece


class ArrayFileError(ValueError):
    """A file of arrays is damaged, or an array is missing, of no plain type, or larger than it may be."""


class ArrayTooLargeError(ArrayFileError):
    """An array is larger than it may be."""


@dataclass(frozen=True)
class ArrayHeader:
    """What an array says of itself."""

    shape: tuple[int, ...]  # its shape
    columns_first: bool  # whether it is stored in Fortran's order
    dtype: np.dtype[Any]  # its type: numbers, bool or texts
    offset: int  # bytes before its values

    @property
    def nbytes(self) -> int:
        """Bytes of its values."""
        return math.prod(self.shape) * self.dtype.itemsize


class ArrayFile:
    """An open ``.npz`` file; nothing is unpickled.

    Args:
        path: The file.

    Attributes:
        names: Names of its arrays.
        bytes: Length of the file.

    Raises:
        OSError: If it cannot be opened.
        ArrayFileError: If it is no archive.
    """

    def __init__(self, path: Path) -> None:
        with _reading():
            self._archive = zipfile.ZipFile(path)
        self._members = {one.filename.removesuffix(".npy"): one for one in self._archive.infolist()}
        self.names = tuple(self._members)
        self.bytes = path.stat().st_size

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._archive.close()

    def header(self, name: str) -> ArrayHeader:
        """What an array says of itself, which its length in the archive confirms.

        Raises:
            ArrayFileError: If there is no such array, or it is damaged or of no plain type.
        """
        with _reading(), self.open(name) as stream:
            version = npy.read_magic(stream)
            if version not in ((1, 0), (2, 0)):
                raise ArrayFileError(f"{name} is of an unknown version of numpy's format")
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            header = ArrayHeader(*read(stream), stream.tell())
        if header.dtype.kind not in _PLAIN:
            raise ArrayFileError(f"{name} is of type {header.dtype}, but only numbers and texts are read")
        if header.offset + header.nbytes != self._members[name].file_size:
            raise ArrayFileError(f"{name} is longer or shorter than its shape {header.shape}")
        return header

    def read(self, name: str, most: int = LARGEST) -> NDArray[Any]:
        """An array.

        Args:
            name: Its name.
            most: Bytes that it may have.

        Raises:
            ArrayFileError: If there is no such array, or it is damaged or of no plain type.
            ArrayTooLargeError: If it is larger than ``most``.
        """
        header = self.header(name)
        if header.nbytes > most:
            shape = " x ".join(map(str, header.shape))
            raise ArrayTooLargeError(f"{name} has {shape} values, which take {header.nbytes / 1e6:.0f} MB")
        with _reading(), self.open(name) as stream:
            values: NDArray[Any] = npy.read_array(stream, allow_pickle=False)
        return values

    def open(self, name: str) -> IO[bytes]:
        """The bytes of an array with its header, uncompressed.

        Raises:
            ArrayFileError: If there is no such array, or it is compressed as numpy does not.
        """
        member = self._members.get(name)
        if member is None:
            raise ArrayFileError(f"it has no array {name}")
        if member.compress_type not in _METHODS:
            raise ArrayFileError(f"{name} is compressed as numpy does not")
        with _reading():
            return self._archive.open(member)


@contextmanager
def _reading() -> Iterator[None]:
    try:
        yield
    except (ArrayFileError, OSError):
        raise
    except Exception as error:  # a damaged archive raises whatever its bytes lead to
        raise ArrayFileError(str(error) or type(error).__name__) from error
