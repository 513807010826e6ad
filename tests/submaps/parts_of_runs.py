"""What parts of a video come to, without tracking them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import Status
from tracking3d.geometry.similarity import Similarity
from tracking3d.results.records import FrameRecord


def record_of(index: int, T_cam_obj: np.ndarray, status: Status = Status.TRACKED) -> FrameRecord:
    """An answer."""
    return FrameRecord(
        index, None, f"{index:03d}.png", T_cam_obj, status, "", 0.9, {}, 1, False, 0.1, 0.9, 100
    )


def records_of(indices: range, poses: np.ndarray, status: Status = Status.TRACKED) -> list[FrameRecord]:
    """Answers for frames whose poses ``(N, 4, 4)`` are those of all frames."""
    return [record_of(index, poses[index], status) for index in indices]


def turning(count: int, degrees: float = 3.0) -> np.ndarray:
    """Poses of an object that turns and sways in front of a camera."""
    T = np.tile(np.eye(4), (count, 1, 1))
    angles = np.radians(degrees) * np.arange(count)
    T[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * np.array([0.3, 0.9, -0.2])).as_matrix()
    T[:, :3, 3] = np.stack([0.3 * np.sin(angles), 0.1 * np.cos(angles), 4.5 + 0.2 * np.sin(2 * angles)], 1)
    return T


def inverse(similarity: Similarity) -> Similarity:
    """The way back."""
    R = similarity.R.T
    return Similarity(R, 1 / similarity.scale, -R @ similarity.translation / similarity.scale)


def degrees_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two rotations."""
    return float(np.degrees(Rotation.from_matrix(a.T @ b).magnitude()))
