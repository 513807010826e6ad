"""Trajectories in the TUM format: ``timestamp tx ty tz qx qy qz qw`` in each line.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers.text_files import read_text
from tracking3d_bench.datasets.truth import Truth

_TIMING = 0.25
"""Tolerance of a timestamp in frames."""


def answers_from_tum(
    file: Path, truth: Truth, of: Literal["object", "camera"] = "object", fps: float | None = None
) -> Answers:
    """Poses by timestamp; frames that have none are unanswered.

    Args:
        file: The trajectory; lines with ``#`` in front are comments.
        truth: The clip.
        of: ``object`` if the lines are the object's poses in camera coordinates, ``T_cam_obj``; ``camera`` if they
            are the camera's poses in object coordinates, ``T_obj_cam``, as SLAM programs give them.
        fps: Frames a second if timestamps are in seconds since frame 0; None if they are frame indices.

    Raises:
        InputError: If the file is no trajectory, two lines are about one frame, or none about a frame of the clip.
    """
    if of not in ("object", "camera"):
        raise InputError(f"The poses of {file} cannot be of '{of}'; choose object or camera.")
    if fps is not None and not 0 < fps < np.inf:
        raise InputError(f"{fps:g} frames per second is not a frame rate; give a positive number.")
    poses: dict[int, NDArray[np.float64]] = {}
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        time, T = _parse(file, number, line)
        frame = time * (fps or 1.0)
        if not abs(frame) < 2**53 or abs(frame - round(frame)) > _TIMING:
            raise InputError(
                f"Line {number} of {file}: timestamp {time:g} is not the time of a frame; timestamps are "
                f"{'seconds since frame 0' if fps else 'frame indices unless a frame rate is given'}."
            )
        if round(frame) in poses:
            raise InputError(f"Line {number} of {file} is a second pose of frame {round(frame)}; remove one.")
        poses[round(frame)] = T if of == "object" else _inverse(T)
    poses = {n: T for n, T in poses.items() if 0 <= n < len(truth.frames)}
    if not poses:
        raise InputError(f"{file} has no pose for a frame of the clip {truth.name}; check its timestamps.")
    return Answers(
        origin=file,
        asked=range(len(truth.frames)),
        answered=frozenset(poses),
        T_cam_obj=dict(sorted(poses.items())),
    )


def _parse(file: Path, number: int, line: str) -> tuple[float, NDArray[np.float64]]:
    try:
        values = np.array([float(value) for value in line.split()])
    except ValueError as error:
        raise InputError(f"Line {number} of {file} has values that are not numbers; correct it.") from error
    if len(values) != 8 or not np.isfinite(values).all() or abs(np.linalg.norm(values[4:]) - 1) > 0.01:
        raise InputError(
            f"Line {number} of {file} is not timestamp tx ty tz qx qy qz qw with a unit quaternion; correct it."
        )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[4:]).as_matrix()
    T[:3, 3] = values[1:4]
    return float(values[0]), T


def _inverse(T: NDArray[np.float64]) -> NDArray[np.float64]:
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse
