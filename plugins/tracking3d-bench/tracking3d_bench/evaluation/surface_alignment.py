"""The similarity between two object frames that fits the surfaces, from the one that fits the poses.

If no focal length was given, a method's shape can be right in all but its size: a focal length that is off takes the
object nearer or farther, and the scale that fits the poses is then that of the distances, not of the object. As for
"Tanks and temples" (Knapitsch et al., 2017) poses say where to begin, and the surfaces how to go on. If the size is off
by more than closest points can bridge, the surfaces' own size is a second start.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

SAMPLES = 4000
"""Points on each surface."""
_STEPS = 40
_SCALE = 0.01  # distance in diameters at which a pair counts half
_SHARE = 0.8  # of the true surface's points that are assumed to have a counterpart
_NEAR = 0.02  # in diameters; those that are as near always have
_FARTHEST = 0.05  # change of size in a step
_HELD = 1e-4  # what the surfaces leave open, such as turning a ball, stays


def align_surfaces(
    estimated: trimesh.Trimesh,
    true: trimesh.Trimesh,
    diameter: float,
    T_true_est: NDArray[np.float64],
    seen: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]] | None = None,
) -> list[NDArray[np.float64]]:
    """Similarities ``(4, 4)`` from estimated to true coordinates, by iterative closest points, point to plane.

    Begun at the poses' similarity, and at the size of the surfaces; which is better is for the caller to score. If
    little was seen, such as three sides of a box at a corner, closest points leave the size open, and neither is good.

    Args:
        estimated: In estimated object coordinates.
        true: In true object coordinates.
        diameter: Diameter of the true mesh, in its unit.
        T_true_est: ``(4, 4)`` where to begin, such as `tracking3d_bench.evaluation.alignment` gives.
        seen: Says of points ``(N, 3)`` of the true surface with normals ``(N, 3)`` which were seen; the others have no
            say.
    """
    points = np.asarray(trimesh.sample.sample_surface(estimated, SAMPLES, seed=0)[0])
    targets, faces = trimesh.sample.sample_surface(true, SAMPLES, seed=1)
    targets, normals = np.asarray(targets), true.face_normals[faces]
    if seen is not None and (shown := seen(targets, normals)).any():
        targets, normals = targets[shown], normals[shown]
    starts = (T_true_est, _scaled_to_size(T_true_est, points, targets))
    return [_closest_points(start, points, targets, normals, diameter) for start in starts]


def _scaled_to_size(
    T: NDArray[np.float64], points: NDArray[np.float64], targets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The similarity with the scale and the position that give points the targets' spread and middle."""
    moved = points @ T[:3, :3].T
    scale = float(np.sqrt(targets.var(0).sum() / max(moved.var(0).sum(), 1e-300)))
    scaled = np.array(T, np.float64)
    scaled[:3, :3] *= scale
    scaled[:3, 3] = targets.mean(0) - scale * moved.mean(0)
    return scaled


def _closest_points(
    T_true_est: NDArray[np.float64],
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    normals: NDArray[np.float64],
    diameter: float,
) -> NDArray[np.float64]:
    T = np.array(T_true_est, np.float64)
    for _ in range(_STEPS):
        moved = points @ T[:3, :3].T + T[:3, 3]
        distance, nearest = cKDTree(moved).query(targets)
        pairs = distance <= max(_NEAR * diameter, np.quantile(distance, _SHARE))
        T = _step(moved[nearest[pairs]], targets[pairs], normals[pairs], diameter) @ T
    return T


def _step(
    points: NDArray[np.float64], targets: NDArray[np.float64], normals: NDArray[np.float64], diameter: float
) -> NDArray[np.float64]:
    """``(4, 4)`` small similarity that takes points ``(N, 3)`` nearer to the planes of their targets."""
    middle = targets.mean(0)
    arm = (points - middle) / diameter
    apart = ((targets - points) * normals).sum(1) / diameter
    rows = np.column_stack([np.cross(arm, normals), normals, (arm * normals).sum(1)])
    weighted = rows / (1 + (apart[:, None] / _SCALE) ** 2)
    matrix = weighted.T @ rows
    matrix += _HELD * np.trace(matrix) / 7 * np.eye(7)
    change = np.linalg.solve(matrix, weighted.T @ apart)
    T = np.eye(4)
    T[:3, :3] = (1 + np.clip(change[6], -_FARTHEST, _FARTHEST)) * Rotation.from_rotvec(change[:3]).as_matrix()
    T[:3, 3] = middle + diameter * change[3:6] - T[:3, :3] @ middle
    return T
