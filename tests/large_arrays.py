"""Arrays of zeros that are small on disk and large in memory."""

from __future__ import annotations

import math
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

_CHUNK = bytes(2**22)


def write_zeros(file: Path, dtype: str = "|u1", **shapes: tuple[int, ...]) -> Path:
    """An ``.npz`` of arrays of zeros, written without having them in memory."""
    with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, shape in shapes.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                about = {"descr": dtype, "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, about)
                left = math.prod(shape) * np.dtype(dtype).itemsize
                while left > 0:
                    stream.write(_CHUNK[:left])
                    left -= len(_CHUNK)
    return file


@contextmanager
def memory_stays_below(most: int) -> Iterator[None]:
    """What the block allocates at a time has at most so many bytes."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < most, f"{peak / 1e6:.0f} MB"
