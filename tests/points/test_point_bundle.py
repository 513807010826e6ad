from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.points.bundle import bundle, intersect

RNG = np.random.default_rng(3)
POINTS = RNG.uniform(-1, 1, (40, 3))
INTRINSICS = np.tile([300.0, 310.0, 80.0, 60.0], (9, 1))


def poses(count: int = 9) -> np.ndarray:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(
        np.deg2rad(np.linspace(0, 50, count))[:, None] * np.array([0.0, 1.0, 0.0])
    ).as_matrix()
    T[:, :3, 3] = [0.1, -0.2, 6.0]
    return T


def projected(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    seen = points @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
    return seen[..., :2] / seen[..., 2:] * INTRINSICS[:, None, :2] + INTRINSICS[:, None, 2:]


def test_points_come_to_lie_where_the_views_saw_them():
    start = POINTS + RNG.normal(0, 0.05, POINTS.shape)
    measured = projected(POINTS, poses())
    found, weight = intersect(
        start, INTRINSICS, poses(), measured, np.full(measured.shape[:2], 0.1), held=1.0
    )
    assert np.abs(found - POINTS).max() < 2e-3
    assert (weight > 0).all()


def test_a_wrong_measurement_hardly_counts():
    measured = projected(POINTS, poses())
    measured[4] += 25.0
    found, weight = intersect(
        POINTS, INTRINSICS, poses(), measured, np.full(measured.shape[:2], 0.1), held=1.0
    )
    assert np.abs(found - POINTS).max() < 2e-3
    assert (weight[4] < 1e-2 * weight[3]).all()


def test_without_measurements_nothing_moves():
    measured = np.full((9, 40, 2), np.nan)
    nothing = np.full((9, 40), np.inf)
    points, T, weight = bundle(POINTS, INTRINSICS, poses(), measured, nothing, 0.1, 0.03, 0.03)
    assert np.array_equal(points, POINTS)
    assert np.allclose(T, poses(), atol=1e-12)
    assert (weight == 0).all()


def test_poses_that_are_off_are_put_right_up_to_the_priors():
    T = poses()
    off = T.copy()
    turns = Rotation.from_rotvec(np.deg2rad(RNG.normal(0, 1, (9, 3)))).as_matrix()
    off[:, :3, :3] = turns @ T[:, :3, :3]
    measured = projected(POINTS, T)
    points, found, _ = bundle(
        POINTS, INTRINSICS, off, measured, np.full((9, 40), 0.1), 0.1, 0.1, 0.1, turns=30
    )
    before, after = (np.abs(projected(p, Ts) - measured).max() for p, Ts in ((POINTS, off), (points, found)))
    assert before > 2
    assert after < 0.1
    assert np.allclose(found[:, :3, :3] @ found[:, :3, :3].transpose(0, 2, 1), np.eye(3), atol=1e-9)
