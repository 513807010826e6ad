"""The 3D points of a COLMAP model, text or binary. Format: https://colmap.github.io/format.html"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d_bench.datasets.readers.text_files import read_text

_COUNT = struct.Struct("<Q")
_POINT = struct.Struct("<Q3d3BdQ")
"""Point, place, colour, error, number of observations."""
_OBSERVATION_SIZE = 8
"""Bytes of two integers."""


def read_points(model: Path) -> NDArray[np.float64]:
    """The places ``(N, 3)`` of a model's points in world coordinates; none if it has no points file.

    Args:
        model: Folder of ``points3D.bin`` or ``points3D.txt``.

    Raises:
        InputError: If the file is damaged.
    """
    binary, text = model / "points3D.bin", model / "points3D.txt"
    if binary.is_file():
        points = _read_binary(binary)
    elif text.is_file():
        points = _read_lines(text)
    else:
        points = np.empty((0, 3))
    return points[np.isfinite(points).all(axis=1)]


def _read_lines(file: Path) -> NDArray[np.float64]:
    points = []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            try:
                _, x, y, z, *_ = line.split()
                points.append((float(x), float(y), float(z)))
            except ValueError as error:
                raise InputError(
                    f"Line {number} of {file} is not POINT3D_ID X Y Z ...; export the model again."
                ) from error
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _read_binary(file: Path) -> NDArray[np.float64]:
    try:
        data = file.read_bytes()
        (count,) = _COUNT.unpack_from(data)
        position, points = _COUNT.size, []
        for _ in range(count):
            _, x, y, z, *_, observations = _POINT.unpack_from(data, position)
            points.append((x, y, z))
            position += _POINT.size + _OBSERVATION_SIZE * observations
    except (OSError, struct.error) as error:
        raise InputError(
            f"{file} cannot be read as COLMAP's points ({error}); export the model again."
        ) from error
    return np.array(points, dtype=np.float64).reshape(-1, 3)
