"""BOP pose errors and recalls by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from tracking3d_bench.evaluation.bop import (
    THRESHOLDS,
    add,
    adi,
    average_recall,
    model_diameter,
    mspd,
    mssd,
    rotation_error,
    translation_error,
)

K = np.array([[500.0, 0, 320], [0, 400, 240], [0, 0, 1]])
BRICK = np.array([[x, y, z] for x in (-10, 10) for y in (-20, 20) for z in (-30, 30)], dtype=float)
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
"""About z: it leaves the brick as it is."""


def pose(rotation=(0, 0, 0), translation=(0, 0, 500)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(rotation)).as_matrix()
    T[:3, 3] = translation
    return T


def shifted(*shift):
    return pose(translation=np.array([0, 0, 500]) + shift)


def all_measures(T_est, T_true):
    return (
        mssd(T_est, T_true, BRICK),
        mspd(T_est, T_true, K, BRICK),
        add(T_est, T_true, BRICK),
        adi(T_est, T_true, BRICK),
        rotation_error(T_est, T_true),
        translation_error(T_est, T_true),
    )


def test_a_perfect_pose_has_no_error_by_any_measure():
    T = pose((20, -40, 70), (30, -10, 600))
    assert all_measures(T, T) == pytest.approx((0,) * 6, abs=1e-6)


def test_a_shift_moves_every_point_as_far():
    T = shifted(3, 4, 0)
    assert mssd(T, pose(), BRICK) == pytest.approx(5)
    assert add(T, pose(), BRICK) == pytest.approx(5)
    assert translation_error(T, pose()) == 5
    assert rotation_error(T, pose()) == 0


def test_a_sideways_shift_projects_largest_at_the_nearest_points():
    # The nearest corners are at depth 470.
    assert mspd(shifted(4, 0, 0), pose(), K, BRICK) == pytest.approx(500 * 4 / 470)
    assert mspd(shifted(0, 4, 0), pose(), K, BRICK) == pytest.approx(400 * 4 / 470)


@pytest.mark.parametrize("angle", [1.0, 35.0, 180.0])
def test_a_turn_is_its_angle_and_moves_the_farthest_corner_most(angle):
    T = pose((0, 0, angle))
    assert rotation_error(T, pose()) == pytest.approx(angle)
    chord = 2 * np.sin(np.radians(angle) / 2)
    assert mssd(T, pose(), BRICK) == pytest.approx(chord * np.hypot(10, 20))
    assert add(T, pose(), BRICK) == pytest.approx(chord * np.hypot(10, 20))


def test_a_symmetric_pose_has_no_error_where_symmetries_are_known():
    T = pose((10, 20, 30), (5, 6, 400))
    turned, known = T @ HALF_TURN, np.stack([np.eye(4), HALF_TURN])
    assert mssd(turned, T, BRICK) > 40
    assert mssd(turned, T, BRICK, known) == pytest.approx(0, abs=1e-9)
    assert mspd(turned, T, K, BRICK, known) == pytest.approx(0, abs=1e-9)
    assert add(turned, T, BRICK) > 40
    assert adi(turned, T, BRICK) == pytest.approx(0, abs=1e-9)


def test_the_symmetry_that_fits_best_counts():
    T = shifted(1, 0, 0) @ HALF_TURN
    assert mssd(T, pose(), BRICK, np.stack([np.eye(4), HALF_TURN])) == pytest.approx(1)


def test_symmetries_may_be_about_an_axis_beside_the_origin():
    beside = np.diag([-1.0, -1.0, 1.0, 1.0])
    beside[0, 3] = 40
    points = np.concatenate([BRICK, BRICK @ beside[:3, :3].T + beside[:3, 3]])
    T = pose((10, 20, 30))
    assert mssd(T @ beside, T, points, np.stack([np.eye(4), beside])) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_errors_are_those_found_point_by_point(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(40, 3)) * 30
    T_est, T_true = (
        pose(random.normal(size=3) * 60, random.normal(size=3) * 30 + [0, 0, 500]) for _ in range(2)
    )
    seen_est, seen_true = ([T[:3, :3] @ x + T[:3, 3] for x in points] for T in (T_est, T_true))
    distances = [np.linalg.norm(a - b) for a, b in zip(seen_est, seen_true, strict=True)]
    pixels = [
        np.hypot(500 * (a[0] / a[2] - b[0] / b[2]), 400 * (a[1] / a[2] - b[1] / b[2]))
        for a, b in zip(seen_est, seen_true, strict=True)
    ]
    assert mssd(T_est, T_true, points) == pytest.approx(max(distances))
    assert mspd(T_est, T_true, K, points) == pytest.approx(max(pixels))
    assert add(T_est, T_true, points) == pytest.approx(np.mean(distances))
    # From the true pose to the estimated one; the other way round is another figure.
    nearest = cdist(seen_true, seen_est)
    assert adi(T_est, T_true, points) == pytest.approx(nearest.min(1).mean())
    assert adi(T_est, T_true, points) != pytest.approx(nearest.min(0).mean())
    relative = Rotation.from_matrix(T_est[:3, :3] @ T_true[:3, :3].T)
    assert rotation_error(T_est, T_true) == pytest.approx(np.degrees(relative.magnitude()))


def test_a_point_in_the_cameras_plane_projects_infinitely_far():
    assert mspd(pose(translation=(0, 0, 30)), pose(), K, BRICK) == np.inf
    assert mspd(pose(translation=(0, 0, 30)), pose(), K, np.array([[0, 0, -30.0]])) == np.inf


def test_the_diameter_is_the_longest_diagonal():
    assert model_diameter(BRICK) == pytest.approx(2 * np.linalg.norm([10, 20, 30]))
    points = np.random.default_rng(0).normal(size=(200, 3))
    assert model_diameter(points) == pytest.approx(cdist(points, points).max())


def test_thresholds_are_those_of_bop():
    np.testing.assert_allclose(THRESHOLDS, [0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5])


def test_recall_is_averaged_over_thresholds_and_tolerances():
    vsd = np.array([[0.12] * 10, [1.0] * 10])  # right at 8 of 10 thresholds, and at none
    scores = average_recall(vsd, [22.0, 60.0], [3.0, 22.0], diameter=100, image_width=640)
    assert scores.vsd == pytest.approx(0.4)
    assert scores.mssd == pytest.approx((6 / 10 + 0) / 2)
    assert scores.mspd == pytest.approx((10 / 10 + 6 / 10) / 2)
    assert scores.mean == pytest.approx((0.4 + 0.3 + 0.8) / 3)


def test_vsd_counts_every_pair_of_tolerance_and_threshold():
    vsd = np.full((1, 10), 1.0)
    vsd[0, 9] = 0.0
    assert average_recall(vsd, None, None, 1.0, 640).vsd == pytest.approx(0.1)


def test_a_pose_exactly_at_a_threshold_is_wrong():
    assert average_recall(None, [50.0], [50.0], 100, 640).mspd == 0.0
    assert average_recall(None, [50.0], [50.0], 100, 640).mssd == 0.0


def test_pixels_count_as_if_the_image_were_640_wide():
    assert (
        average_recall(None, None, [44.0], 100, 1280).mspd
        == average_recall(None, None, [22.0], 100, 640).mspd
    )


def test_a_frame_without_an_estimate_is_wrong_at_every_threshold():
    scores = average_recall(np.full((2, 10), np.inf), [np.inf, 0], [np.inf, 0], 100, 640)
    assert (scores.vsd, scores.mssd, scores.mspd) == (0.0, 0.5, 0.5)


def test_without_depth_there_is_no_average_of_the_three():
    scores = average_recall(None, [0.0], [0.0], 100, 640)
    assert (scores.vsd, scores.mssd, scores.mspd, scores.mean) == (None, 1.0, 1.0, None)
    assert average_recall(np.empty((0, 10)), [], [], 100, 640).mssd is None


def test_what_does_not_fit_is_refused():
    T = pose()
    with pytest.raises(ValueError, match=r"T_est needs shape \(4, 4\), got \(3, 4\)"):
        mssd(T[:3], T, BRICK)
    with pytest.raises(ValueError, match=r"points needs shape \(any, 3\), got \(8, 2\)"):
        add(T, T, BRICK[:, :2])
    with pytest.raises(ValueError, match="P > 0"):
        adi(T, T, np.empty((0, 3)))
    with pytest.raises(ValueError, match="S > 0"):
        mssd(T, T, BRICK, np.empty((0, 4, 4)))
    with pytest.raises(ValueError, match=r"T_true .* not finite"):
        mspd(T, T * np.nan, K, BRICK)
    with pytest.raises(ValueError, match=r"vsd_errors needs shape \(any, any\), got \(3,\)"):
        average_recall([0.1, 0.2, 0.3], None, None, 100, 640)
    for diameter, width in ((0.0, 640), (np.nan, 640), (1.0, 0)):
        with pytest.raises(ValueError, match="need to be positive"):
            average_recall(None, [0.0], [0.0], diameter, width)
