"""The similarity that aligns the object frame of an estimate with ground truth, and the remaining translation errors.

The camera frame is common. The object frames differ by a rotation ``A`` and an ``offset``, and the whole estimated
scene by one ``scale``, because one camera cannot tell size from distance. The true origin lies at ``offset`` in the
estimated object frame::

    x_est  = A x_true / scale + offset
    R_true = R_est A
    t_true = scale (R_est offset + t_est)

All frames of a clip share the three. Poses are ``T_cam_obj``; OpenCV axes.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Poses = NDArray[np.float64]
"""``(N, 4, 4)`` rigid transforms ``T_cam_obj``."""

Rotations = NDArray[np.float64]
"""``(N, 3, 3)`` rotation matrices."""

SAMPLES = 100
"""Sets of three frames whose exact fits are tried as starts."""

_CANDIDATES = 100
_REFINED = 5
_STEPS = 100
_RANK = 1e-6  # a direction whose singular value is this small relative to the largest is not determined


@dataclass(frozen=True, eq=False)
class ObjectAlignment:
    """How an estimated object frame lies in the true one; see the module."""

    A: NDArray[np.float64]  # (3, 3) rotation from the true to the estimated object frame
    scale: float  # length of the estimate's unit in that of the truth
    offset: NDArray[np.float64]  # (3,) the true origin in the estimated object frame and unit

    @property
    def T_true_est(self) -> NDArray[np.float64]:
        """``(4, 4)`` similarity from estimated to true object coordinates, for points and meshes."""
        T = np.eye(4)
        T[:3, :3] = self.scale * self.A.T
        T[:3, 3] = -T[:3, :3] @ self.offset
        return T

    def poses(self, T_cam_obj: Poses) -> Poses:
        """Estimated poses ``(N, 4, 4)`` as poses of the true object frame, in the truth's unit.

        Raises:
            ValueError: If they have another shape.
        """
        R, t = split_poses("T_cam_obj", T_cam_obj)
        aligned = np.tile(np.eye(4), (len(R), 1, 1))
        aligned[:, :3, :3] = R @ self.A
        aligned[:, :3, 3] = self.scale * (R @ self.offset + t)
        return aligned


def rotation_alignment(R_est: Rotations, R_true: Rotations) -> NDArray[np.float64]:
    """The ``(3, 3)`` rotation ``A`` with the least sum of angles between ``R_est A`` and ``R_true``.

    That is the geodesic L1 median of ``R_est^T R_true``, robust to a minority of wrong frames. It has local
    minima, so the frames' own estimates are the starts and Weiszfeld steps on SO(3) refine the best of them
    (Hartley, Aftab and Trumpf, "L1 rotation averaging using the Weiszfeld algorithm", CVPR 2011).

    Raises:
        ValueError: If there is no frame, or the shapes differ.
    """
    offsets = transposed_product(R_est, R_true)
    spread = np.unique(np.linspace(0, len(offsets) - 1, _CANDIDATES).round().astype(int))
    starts = [offsets[int(n)] for n in spread]
    costs = np.array([_magnitudes(start, offsets).sum() for start in starts])
    best = [starts[n] for n in np.argsort(costs, kind="stable")[:_REFINED]]
    # A start is kept as it is too: refinement only comes near the minimum if that is one of the frames.
    candidates = best + [_weiszfeld(start, offsets) for start in best]
    return min(candidates, key=lambda A: _magnitudes(A, offsets).sum()).as_matrix()


def align_object_frame(
    T_est: Poses, T_true: Poses, diameter: float | None = None, seed: int = 0
) -> ObjectAlignment:
    """The similarity that fits a clip best, robust to a minority of wrong frames.

    ``A`` is that of `rotation_alignment`. Scale and offset have the least sum of translation errors, where no error
    counts more than half the object's diameter, the loosest threshold of BOP: a frame further off is wrong, how far
    does not matter. No offset is longer than the median estimated distance: object frames are not that far from their
    objects, and longer ones let the scale go to zero, which hides what the estimate says. Fits to three frames, and
    to all, are the starts; reweighted least squares within the limit refines the best of them. What the frames leave
    open, as one frame alone does, is chosen so that the offset is the shortest.

    Args:
        T_est: ``(N, 4, 4)`` finite estimates.
        T_true: ``(N, 4, 4)``.
        diameter: Diameter of the object in the truth's unit. Without it the limit is a tenth of the median distance.
        seed: Seed of the choice of frames.

    Raises:
        ValueError: If there is no frame, the shapes differ, a value is not finite, or the diameter is not positive.
    """
    if diameter is not None and not 0 < diameter < np.inf:
        raise ValueError(f"the diameter needs to be positive, got {diameter}")
    R_est, t_est = split_poses("T_est", T_est)
    R_true, t_true = split_poses("T_true", T_true)
    if len(R_est) != len(R_true) or not len(R_est):
        raise ValueError(
            f"poses need equal shapes (N, 4, 4) with N > 0, got {np.shape(T_est)} and {np.shape(T_true)}"
        )
    # In units of the median distances all columns of the equations have one order of magnitude.
    est_unit, true_unit = (np.median(np.linalg.norm(t, axis=1)) or 1.0 for t in (t_est, t_true))
    M = np.concatenate([R_est, t_est[..., None] / est_unit], axis=2)
    limit = 0.1 if diameter is None else diameter / 2 / true_unit
    *scaled_offset, scale = _fit(M, t_true / true_unit, limit, np.random.default_rng(seed))
    return ObjectAlignment(
        A=rotation_alignment(R_est, R_true),
        scale=float(scale * true_unit / est_unit),
        offset=np.array(scaled_offset) / scale * est_unit,
    )


def split_poses(name: str, T: Poses) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotations ``(N, 3, 3)`` and translations ``(N, 3)`` of finite poses.

    Raises:
        ValueError: If they have another shape, or a value is not finite; names them ``name``.
    """
    poses = np.asarray(T, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise ValueError(f"{name} needs shape (any, 4, 4), got {poses.shape}")
    if not np.isfinite(poses).all():
        raise ValueError(f"{name} {poses.shape} has values that are not finite")
    return poses[:, :3, :3], poses[:, :3, 3]


def transposed_product(a: Rotations, b: Rotations) -> Rotation:
    """``a_n^T b_n`` for every n."""
    if a.shape != b.shape or a.ndim != 3 or not len(a):
        raise ValueError(f"rotations need equal shapes (N, 3, 3) with N > 0, got {a.shape} and {b.shape}")
    return Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)


def _magnitudes(A: Rotation, offsets: Rotation) -> NDArray[np.float64]:
    """Angles between ``A`` and each offset, in radians."""
    return (A.inv() * offsets).magnitude()


def _weiszfeld(start: Rotation, offsets: Rotation) -> Rotation:
    """Iteratively reweighted mean of ``offsets`` in the tangent space, from ``start``."""
    A = start
    for _ in range(_STEPS):
        steps = (A.inv() * offsets).as_rotvec()
        weights = 1 / np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
        step = weights @ steps / weights.sum()
        A = A * Rotation.from_rotvec(step)
        if np.linalg.norm(step) < 1e-12:
            break
    return A


def _fit(
    M: NDArray[np.float64], y: NDArray[np.float64], limit: float, random: np.random.Generator
) -> NDArray[np.float64]:
    """``x`` ``(4,)`` with the least sum of ``min(|M_n x - y_n|, limit)``, and ``x[:3]`` no longer than ``x[3]``.

    Args:
        M: ``(N, 3, 4)``.
        y: ``(N, 3)``.
        limit: What a distance counts at most.
        random: Chooses the samples.
    """

    def cost(x: NDArray[np.float64]) -> float:
        return float(np.minimum(_distances(M, y, x), limit).sum())

    samples = [random.permutation(len(M))[:3] for _ in range(SAMPLES if len(M) > 3 else 0)]
    starts = [_least_squares(M[sample], y[sample]) for sample in samples]
    starts += [_reweight(M, y, np.inf, _least_squares(M, y)), np.array([0.0, 0.0, 0.0, 1.0])]
    best = sorted(filter(_is_plausible, starts), key=cost)[:_REFINED]
    # A start is kept as it is too: refinement need not end below it.
    refined = [_reweight(M, y, limit, start) for start in best]
    return min(best + list(filter(_is_plausible, refined)), key=cost)


def _is_plausible(x: NDArray[np.float64]) -> bool:
    return bool(x[3] > 0 and np.linalg.norm(x[:3]) <= x[3])


def _reweight(
    M: NDArray[np.float64], y: NDArray[np.float64], limit: float, x: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Least squares weighted by the inverse of the last distances (Weiszfeld); those beyond ``limit`` are left out."""
    for _ in range(_STEPS):
        distances = _distances(M, y, x)
        within = distances < limit
        if not within.any():
            break
        root = np.sqrt(1 / np.maximum(distances[within], 1e-12))[:, None]
        last, x = x, _least_squares(root[..., None] * M[within], root * y[within])
        if np.abs(x - last).max() <= 1e-13 * np.abs(x).max():
            break
    return x


def _distances(M: NDArray[np.float64], y: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(M @ x - y, axis=1)


def _least_squares(M: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The minimum ``(4,)`` of the sum of ``|M_n x - y_n|^2`` that has the shortest ``x[:3]``."""
    rows, values = M.reshape(-1, 4), y.ravel()
    missing = max(4 - len(rows), 0)
    U, singular, Vt = np.linalg.svd(np.pad(rows, ((0, missing), (0, 0))), full_matrices=False)
    known = singular > _RANK * singular[0]
    x = Vt[known].T @ (U[:, known].T @ np.pad(values, (0, missing)) / singular[known])
    free = Vt[~known]
    return x - free.T @ np.linalg.lstsq(free[:, :3].T, x[:3], rcond=_RANK)[0] if len(free) else x


ROUNDED = 1e-3
"""Largest entry of ``R R^T - I`` of a rotation that was rounded; chosen, three digits of each number are written."""
NEARLY = 0.02
"""The same of what is replaced by the nearest rotation; chosen. In the truth of a public data set it is .0027."""

_log = logging.getLogger(__name__)


def is_rigid(T: NDArray[np.float64], tolerance: float = ROUNDED) -> bool:
    """Whether ``T`` is a finite ``(4, 4)`` rigid transform."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < tolerance and np.linalg.det(R) > 0)


def nearest_rigid(T: NDArray[np.float64], file: Path) -> NDArray[np.float64] | None:
    """The ``(4, 4)`` rigid transform that a file means by ``T``; None if ``T`` is not even nearly one.

    The nearest rotation in the Frobenius norm takes the place of one that is off by more than `ROUNDED`; that is said
    once a file.
    """
    if is_rigid(T):
        return T
    if not is_rigid(T, NEARLY):
        return None
    _say_once(file)
    U, _, V = np.linalg.svd(T[:3, :3])
    T = T.copy()
    T[:3, :3] = U @ V
    return T


@cache
def _say_once(file: Path) -> None:
    _log.warning("%s: some rotations are so only nearly; the nearest ones are used.", file)
