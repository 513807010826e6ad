"""The similarity between the objects of two runs over the same frames, by their poses and by points that both know.

One camera cannot tell size from distance, so that the objects, and with them the cameras' distances, differ by a scale
beside the rotation and the translation::

    x_first = scale R x_second + translation
    x_cam_first = scale x_cam_second

Rotations of frames are averaged by their geodesic median. Given that, scale and translation are linear in what is
known: a frame's two translations, and a surface point's two places (Umeyama 1991 of points alone). The least sum of
distances is found by reweighting, so that a minority of wrong frames and points does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.geometry.alignment import rotation_alignment
from tracking3d.geometry.similarity import Similarity

Array = NDArray[np.float64]
_STEPS = 50
_CLOSE = 1e-9
_OUTLYING = 3.0  # times the median
_RIGHT = 2.0  # degrees that no frame is left out for
_FLOOR = 1e-3  # of the median distance, so that no single row takes all the weight


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity and its uncertainty."""

    similarity: Similarity  # the similarity
    angles: Array  # (F,) degrees by which it leaves each frame's rotation wrong
    distances: Array  # (F,) the same of translations, in the first's unit
    scale_error: float  # standard error of the scale, relative
    translation_error: float  # standard error of the translation, in the first's unit


def fit_similarity(
    T_cam_first: Array, T_cam_second: Array, x_first: Array | None = None, x_second: Array | None = None
) -> SimilarityFit:
    """Fit the similarity that explains two runs' poses of the same frames best.

    Args:
        T_cam_first: ``(F, 4, 4)`` poses of the first object.
        T_cam_second: ``(F, 4, 4)`` of the second, of the same frames.
        x_first: ``(N, 3)`` surface points of the first object; all of them together count as much as all frames.
        x_second: ``(N, 3)`` the same points on the second.

    Raises:
        ValueError: If there is no frame, or shapes differ.
    """
    if T_cam_first.shape != T_cam_second.shape or T_cam_first.ndim != 3 or not len(T_cam_first):
        raise ValueError(
            f"poses need equal shapes (F, 4, 4) with F > 0, got {T_cam_first.shape} and {T_cam_second.shape}"
        )
    R_first, R_second = T_cam_first[:, :3, :3], T_cam_second[:, :3, :3]
    t_first, t_second = T_cam_first[:, :3, 3], T_cam_second[:, :3, 3]
    R = rotation_alignment(R_first, R_second)
    angles = np.degrees(Rotation.from_matrix(np.swapaxes(R_first @ R, 1, 2) @ R_second).magnitude())
    # A frame whose rotation is wrong has a wrong translation too, and by it more say than others.
    sound = angles <= max(_OUTLYING * float(np.median(angles)), _RIGHT)
    rows = np.concatenate([R_first, -t_second[..., None]], axis=2)[sound]
    values, weight = -t_first[sound], np.full(len(rows), 1 / len(rows))
    if x_first is not None and x_second is not None and len(x_first):
        if x_first.shape != x_second.shape:
            raise ValueError(f"points need equal shapes (N, 3), got {x_first.shape} and {x_second.shape}")
        eye = np.broadcast_to(np.eye(3), (len(x_first), 3, 3))
        rows = np.concatenate([rows, np.concatenate([eye, (x_second @ R.T)[..., None]], axis=2)])
        values = np.concatenate([values, x_first])
        weight = np.concatenate([weight, np.full(len(x_first), 1 / len(x_first))])
    solution, spread = _least_distances(rows, values, weight)
    similarity = Similarity(R, float(solution[3]), solution[:3])
    moved = similarity.poses(T_cam_second)
    distances = np.linalg.norm(moved[:, :3, 3] - t_first, axis=1)
    scale_error = float(np.sqrt(spread[3, 3]) / max(abs(similarity.scale), 1e-12))
    return SimilarityFit(similarity, angles, distances, scale_error, float(np.sqrt(np.trace(spread[:3, :3]))))


def _least_distances(rows: Array, values: Array, weight: Array) -> tuple[Array, Array]:
    """``x`` ``(4,)`` with the least weighted sum of ``|rows_n x - values_n|``, and its covariance ``(4, 4)``.

    What the rows leave open is as short as it can be.
    """
    trust, x, normal = weight, np.zeros(4), np.eye(4)
    for _ in range(_STEPS):
        normal = np.einsum("n,nki,nkj->ij", trust, rows, rows)
        before, x = x, np.linalg.pinv(normal) @ np.einsum("n,nki,nk->i", trust, rows, values)
        distances = np.linalg.norm(rows @ x - values, axis=1)
        usual = float(np.median(distances))
        trust = weight / np.maximum(distances, max(_FLOOR * usual, 1e-12))
        if np.abs(x - before).max() <= _CLOSE * max(float(np.abs(x).max()), 1e-12):
            break
    # As least squares with the final weights: how far the rows' scatter lets the solution move.
    trust = trust / trust.sum()
    normal = np.einsum("n,nki,nkj->ij", trust, rows, rows)
    freedom = max(3 * len(rows) - 4, 1)
    scatter = float(np.sum(trust[:, None] * (rows @ x - values) ** 2)) / freedom * len(rows)
    inverse = np.linalg.pinv(normal, rcond=1e-10)
    return x, scatter * inverse / max(len(rows), 1) + _open(normal)


def _open(normal: Array) -> Array:
    """A covariance without end in the directions that the rows leave open."""
    values, directions = np.linalg.eigh(normal)
    free = directions[:, values < 1e-10 * max(float(values.max()), 1e-300)]
    return np.asarray(1e6 * free @ free.T)
