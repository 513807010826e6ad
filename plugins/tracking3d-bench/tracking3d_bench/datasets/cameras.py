"""Cameras as data sets write them, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.trackers.vot_regions import parse_numbers
from tracking3d_bench.datasets.json_files import read_json

_LARGEST_SKEW = 1.0
"""Pixels. Less than that moves no point of a frame by more than about half a pixel."""


def camera_from_matrix(K: Any, width: Any, height: Any, origin: str) -> Camera:
    """The camera of frames of ``width`` x ``height`` pixels with the intrinsic matrix ``K``.

    Args:
        K: ``(3, 3)``, or its nine values row by row.
        width, height: Whole numbers of pixels.
        origin: What messages and the camera call it: its file.

    Raises:
        InputError: If ``K`` is not the matrix of a pinhole camera with a skew of less than a pixel, or the size
            is not positive.
    """
    try:
        matrix = np.asarray(K, dtype=np.float64).reshape(3, 3)
        width, height = int(width), int(height)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{origin}: K must be 3 x 3 numbers; width and height must be whole numbers."
        ) from error
    pinhole = (
        np.isfinite(matrix).all()
        and min(matrix[0, 0], matrix[1, 1], width, height) > 0
        and abs(matrix[0, 1]) < _LARGEST_SKEW
        and np.allclose(matrix[[1, 2, 2], [0, 0, 1]], 0)
        and np.isclose(matrix[2, 2], 1)
    )
    if not pinhole:
        raise InputError(
            f"{origin}: K must be fx 0 cx, 0 fy cy, 0 0 1 with positive focal lengths; width and height must "
            "be positive."
        )
    fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(fx, fy, cx, cy, width, height, origin)


def read_clip_camera(file: Path) -> Camera:
    """Read ``camera.json`` of the clip layout: K, width, height.

    Raises:
        InputError: If it is not such a file; see `camera_from_matrix`.
    """
    document = read_json(file)
    return camera_from_matrix(document.get("K"), document.get("width"), document.get("height"), str(file))


def read_dataset_intrinsics(file: Path, form: Literal["json", "text"], size: tuple[int, int]) -> Camera:
    """Read a camera file of any data set.

    Args:
        file: JSON with ``K``, ``cam_K`` or ``intrinsics`` (9 numbers, or fx, fy, cx, cy), or with ``fx``, ``fy``,
            ``cx``, ``cy``, and perhaps ``width`` and ``height``. Or text with 4 numbers, or with 9 or more of which
            the first 9 are K row by row.
        form: Which of both.
        size: ``(width, height)`` of the frames, if the file does not say.

    Raises:
        InputError: If it is not such a file; see `camera_from_matrix`.
    """
    if form == "json":
        document = read_json(file)
        numbers = next((document[key] for key in ("K", "cam_K", "intrinsics") if key in document), None)
        if numbers is None:
            numbers = [document.get(key) for key in ("fx", "fy", "cx", "cy")]
            if None in numbers:
                raise InputError(f"{file} has neither K nor fx, fy, cx and cy; restore it.")
        size = document.get("width", size[0]), document.get("height", size[1])
    else:
        try:
            numbers = parse_numbers(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{file} cannot be read as numbers ({error}); restore it.") from error
        numbers = numbers if len(numbers) == 4 else numbers[:9]
    if isinstance(numbers, list) and len(numbers) == 4:
        fx, fy, cx, cy = numbers
        numbers = [fx, 0, cx, 0, fy, cy, 0, 0, 1]
    return camera_from_matrix(numbers, *size, str(file))
