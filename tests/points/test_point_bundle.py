from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from twins import ray_intersection

from tracking3d.geometry.camera import LENS_KNOWN
from tracking3d.points.bundle_adjustment.adjustment import reversal_of
from tracking3d.points.robust_bundle import LEAST_MEASURED, bundle, intersect, solve_reversed

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


def turned(T: np.ndarray, degrees: float) -> np.ndarray:
    """Every pose turned on its own."""
    turns = Rotation.from_rotvec(np.deg2rad(np.random.default_rng(4).normal(0, degrees, (len(T), 3))))
    off = T.copy()
    off[:, :3, :3] = turns.as_matrix() @ T[:, :3, :3]
    return off


def test_points_come_to_lie_where_the_views_saw_them():
    start = POINTS + RNG.normal(0, 0.05, POINTS.shape)
    before = start.copy()
    measured = projected(POINTS, poses())
    found, weight = intersect(
        start, INTRINSICS, poses(), measured, np.full(measured.shape[:2], 0.1), held=1.0
    )
    assert np.array_equal(start, before)
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


def test_the_kernel_moves_points_as_its_twin_does():
    rng = np.random.default_rng(7)
    measured = projected(POINTS, poses()) + rng.normal(0, 0.5, (9, 40, 2))
    deviation = rng.uniform(0.05, 0.5, (9, 40))
    measured[rng.random((9, 40)) < 0.3] = np.nan  # not measured
    deviation[rng.random((9, 40)) < 0.1] = np.inf
    measured[:, 3] = np.nan
    T = poses()
    T[8, 2, 3] = -6.0  # behind the camera
    start = POINTS + rng.normal(0, 0.1, POINTS.shape)
    given = start, INTRINSICS, T, measured, deviation, 0.2
    (mine, weight), (expected, weights) = intersect(*given), ray_intersection.intersect(*given)
    np.testing.assert_allclose(mine, expected, atol=1e-9)
    np.testing.assert_allclose(weight, weights, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(mine[3], start[3])


def test_without_measurements_nothing_moves():
    measured = np.full((9, 40, 2), np.nan)
    nothing = np.full((9, 40), np.inf)
    found = bundle(POINTS, INTRINSICS, poses(), measured, nothing, 0.1)
    assert np.array_equal(found.points, POINTS)
    assert np.array_equal(found.T_cam_obj, poses())
    assert (found.weight == 0).all()
    assert found.focal_factor == 1


def test_a_view_that_holds_few_measurements_keeps_its_pose():
    off = turned(poses(), 1.0)
    measured = projected(POINTS, poses())
    deviation = np.full((9, 40), 0.1)
    deviation[4, LEAST_MEASURED - 1 :] = np.inf
    found = bundle(POINTS, INTRINSICS, off, measured, deviation, 0.1)
    assert np.allclose(found.T_cam_obj[4], off[4], atol=1e-12)
    assert not np.allclose(found.T_cam_obj[5], off[5], atol=1e-3)


def test_poses_that_are_off_are_put_right():
    T = poses()
    off = turned(T, 2.0)
    measured = projected(POINTS, T)
    found = bundle(POINTS, INTRINSICS, off, measured, np.full((9, 40), 0.1), 0.1)
    assert np.abs(projected(POINTS, off) - measured).max() > 4
    assert np.abs(projected(found.points, found.T_cam_obj) - measured).max() < 0.01
    relative, truly = (R @ R[0].T for R in (found.T_cam_obj[:, :3, :3], T[:, :3, :3]))
    assert np.rad2deg(Rotation.from_matrix(relative @ truly.transpose(0, 2, 1)).magnitude()).max() < 0.3


def seen_through(factor: float, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measured pixels, and the points and poses of one who takes the lens for ``factor`` times shorter."""
    T = poses()
    T[:, 2, 3] = 4.0
    measured = projected(POINTS, T) + np.random.default_rng(5).normal(0, noise, (9, 40, 2))
    T[:, 2, 3] /= factor
    lens = INTRINSICS / [factor, factor, 1, 1]
    return measured, lens, T


@pytest.mark.parametrize("factor", [0.6, 1.7])
def test_a_lens_that_nobody_gave_is_found_where_perspective_tells_it(factor):
    measured, lens, T = seen_through(factor, noise=0.1)
    given = bundle(POINTS, lens, T, measured, np.full((9, 40), 0.1), 0.1)
    found = bundle(POINTS, lens, T, measured, np.full((9, 40), 0.1), 0.1, begun=given)
    assert found.focal_factor == pytest.approx(factor, rel=0.05)
    assert given.focal_factor == 1
    assert given.cost > found.cost


def test_noise_is_no_proof_of_another_lens():
    measured, lens, T = seen_through(1.0, noise=1.0)
    given = bundle(POINTS, lens, T, measured, np.full((9, 40), 1.0), 0.1)
    found = bundle(POINTS, lens, T, measured, np.full((9, 40), 1.0), 0.1, begun=given)
    assert found.focal_factor == pytest.approx(1, abs=0.05)


def deviation_of_lens(
    degrees: float, distance: float, seed: int = 5, factor: float = 1.2
) -> tuple[float, float]:
    """Error and standard deviation of the logarithm of a focal length that was taken for ``factor`` times too short."""
    T, random = poses(), np.random.default_rng(seed)
    turns = np.deg2rad(np.linspace(0, degrees, 9))[:, None] * np.array([0.0, 1.0, 0.0])
    T[:, :3, :3], T[:, 2, 3] = Rotation.from_rotvec(turns).as_matrix(), distance
    measured = projected(POINTS, T) + random.normal(0, 0.1, (9, 40, 2))
    T[:, 2, 3] /= factor
    lens, deviation = INTRINSICS / [factor, factor, 1, 1], np.full((9, 40), 0.1)
    given = bundle(POINTS, lens, T, measured, deviation, 0.1)
    found = bundle(POINTS, lens, T, measured, deviation, 0.1, begun=given)
    assert given.focal_deviation is None and found.focal_deviation is not None
    return np.log(found.focal_factor / factor), found.focal_deviation


def test_a_lens_is_certain_after_a_large_turn_seen_from_near_and_uncertain_after_a_small_one_from_afar():
    _, near = deviation_of_lens(60, 4)
    _, far = deviation_of_lens(5, 12)
    assert near < 0.03
    assert far > 0.15


def test_a_lens_that_a_small_turn_excludes_is_left_and_one_that_it_allows_is_kept():
    error, deviation = deviation_of_lens(20, 8, factor=3.0)
    assert deviation > LENS_KNOWN and abs(error) < 0.5 * np.log(3.0)
    error, deviation = deviation_of_lens(20, 8, factor=1.2)
    assert deviation > LENS_KNOWN and error == pytest.approx(-np.log(1.2))


def test_the_error_of_a_lens_is_what_its_deviation_leads_to_expect():
    for degrees, distance in [(60, 4), (30, 4), (60, 12), (5, 12)]:
        of_one = [deviation_of_lens(degrees, distance, seed) for seed in range(3)]
        assert max(abs(error) / deviation for error, deviation in of_one) < 2


def test_a_lens_has_the_same_deviation_whether_it_stays_or_was_changed():
    measured, lens, T = seen_through(0.6, noise=0.1)
    deviation = np.full((9, 40), 0.1)
    given = bundle(POINTS, lens, T, measured, deviation, 0.1)
    changed = bundle(POINTS, lens, T, measured, deviation, 0.1, begun=given)
    again = lens * [changed.focal_factor, changed.focal_factor, 1, 1]
    settled = bundle(POINTS, again, changed.T_cam_obj, measured, deviation, 0.1)
    kept = bundle(POINTS, again, changed.T_cam_obj, measured, deviation, 0.1, begun=settled)
    assert kept.focal_factor == pytest.approx(1, abs=0.02)
    assert kept.focal_deviation == pytest.approx(changed.focal_deviation, rel=0.2)


@pytest.mark.parametrize("wrong", [False, True])
def test_the_way_round_that_explains_the_measurements_is_found(wrong):
    T, measured = poses(), projected(POINTS, poses()) + RNG.normal(0, 0.1, (9, 40, 2))
    reversal = reversal_of(POINTS, T[4])
    points, begun = (reversal.points(POINTS), reversal.poses(T)) if wrong else (POINTS, T)
    solved = partial(
        bundle, intrinsics=INTRINSICS, measured=measured, deviation=np.full((9, 40), 0.1), held=0.3
    )
    other = solve_reversed(points, begun, solved, solved(points, T_cam_obj=begun))
    assert other.is_better == wrong
    assert other.is_hopeless != wrong
    if not wrong:
        return
    found = other.found
    relative = found.T_cam_obj[:, :3, :3] @ found.T_cam_obj[0, :3, :3].T
    true = T[:, :3, :3] @ T[0, :3, :3].T
    off = Rotation.from_matrix(relative @ true.transpose(0, 2, 1)).magnitude()
    assert np.degrees(off).max() < 1
