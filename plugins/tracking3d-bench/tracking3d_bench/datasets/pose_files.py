"""Poses in text files of matrices."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.geometry.alignment import nearest_rigid
from tracking3d.trackers.vot_regions import parse_numbers


def read_matrices(files: Mapping[int, Path], *, inverse: bool = False) -> dict[int, NDArray[np.float64]]:
    """Read one file a frame, each with 3 x 4 or 4 x 4 numbers. All NaN is no pose.

    Args:
        files: By frame index.
        inverse: Whether they hold ``T_obj_cam`` instead of ``T_cam_obj``.

    Returns:
        ``T_cam_obj`` ``(4, 4)`` by frame index.

    Raises:
        InputError: If a file is not of that kind.
    """
    poses = {index: _pose(_text(file), inverse, file) for index, file in files.items()}
    return {index: T for index, T in poses.items() if T is not None}


def read_matrix_lines(file: Path, *, inverse: bool = False) -> dict[int, NDArray[np.float64]]:
    """Read one file with 12 or 16 numbers a line, for one frame after the other; see `read_matrices`.

    Raises:
        InputError: If a line is damaged; names file and line.
    """
    lines = _text(file).rstrip().splitlines()
    poses = {n: _pose(line, inverse, file, f", line {n + 1}") for n, line in enumerate(lines)}
    return {index: T for index, T in poses.items() if T is not None}


def _pose(text: str, inverse: bool, file: Path, line: str = "") -> NDArray[np.float64] | None:
    where = f"{file}{line}"
    try:
        numbers = np.array(parse_numbers(text))
        T = np.eye(4)
        if len(numbers) == 16:
            T = numbers.reshape(4, 4)
        else:
            T[:3] = numbers.reshape(3, 4)
    except ValueError as error:
        raise InputError(f"{where} is not a pose of 3 x 4 or 4 x 4 numbers ({error}); correct it.") from error
    if np.isnan(numbers).all():
        return None
    if not np.allclose(T[3], (0, 0, 0, 1)) or (rigid := nearest_rigid(T, file)) is None:
        raise InputError(f"{where}: the pose is not a rotation and a translation; correct it.")
    T = rigid
    if inverse:
        T[:3, 3] = -T[:3, :3].T @ T[:3, 3]
        T[:3, :3] = T[:3, :3].T.copy()
    return T


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as text ({error}); restore it.") from error
