"""The pose of a known object is found from where its points are seen, wrong ones among them, or is not claimed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from tracked_solids import degrees_between, scene

from tracking3d.estimation.online.optimization.pnp import pose_from_points, pose_of_tracks
from tracking3d.points.bundle_adjustment.reprojection import apply_pose_steps
from tracking3d.rendering.normal_equations import NormalEquations

THRESHOLD = 1.5


def point_equations(points, pixels, weight, K, R, t, scale):
    """The equations at a pose."""
    return pose_of_tracks(points, pixels, weight, K, R, t, scale, iterations=0)


def seen(turn: float = 40.0, noise: float = 0.0, **settings):
    """K, points, pixels and pose of the second of two frames."""
    given = scene(frames=2, turn=turn, noise=noise, **settings)
    return given.K, given.truth.points, given.tracks.pixels[1].copy(), given.truth.R[1], given.truth.t[1]


@pytest.mark.parametrize("shape", ["ellipsoid", "box", "plane"])
def test_exact_points_give_the_exact_pose_without_a_start(shape):
    K, points, pixels, R, t = seen(shape=shape)
    found = pose_from_points(points, pixels, K, threshold=THRESHOLD, seed=0)
    assert found is not None
    assert found.inliers.all()
    assert found.count == len(points)
    assert degrees_between(found.R, R)[0] < 1e-4
    assert np.allclose(found.t, t, atol=1e-5)
    assert found.residual < 1e-4


@pytest.mark.parametrize("fov", [10.0, 45.0])
@pytest.mark.parametrize("shape", ["ellipsoid", "plane"])
def test_four_in_ten_wrong_points_are_told_apart(shape, fov):
    K, points, pixels, R, _ = seen(noise=0.3, shape=shape, fov=fov)
    random = np.random.default_rng(0)
    wrong = random.random(len(points)) < 0.4
    pixels[wrong] += 25 * random.normal(size=(wrong.sum(), 2))
    found = pose_from_points(points, pixels, K, threshold=THRESHOLD, seed=0)
    assert found is not None
    assert np.mean(found.inliers == ~wrong) > 0.95
    assert degrees_between(found.R, R)[0] < 1.0
    assert 0.2 < found.residual < 0.6


def test_the_answer_depends_on_the_seed_alone():
    K, points, pixels, _, _ = seen(noise=1.0)
    estimates = []
    for state in (1, 2, 3):
        cv2.setRNGSeed(state)
        estimates.append(pose_from_points(points, pixels, K, threshold=THRESHOLD, seed=3))
    first, *others = estimates
    assert first is not None
    for other in others:
        assert other is not None
        assert np.array_equal(first.R, other.R)
        assert np.array_equal(first.inliers, other.inliers)


def test_rows_that_are_not_finite_are_no_inliers():
    K, points, pixels, R, _ = seen()
    pixels[0], pixels[1, 0] = np.nan, np.inf
    points = points.copy()
    points[2] = np.nan
    found = pose_from_points(points, pixels, K, threshold=THRESHOLD, seed=0)
    assert found is not None
    assert not found.inliers[:3].any()
    assert found.inliers[3:].all()
    assert degrees_between(found.R, R)[0] < 1e-4


def test_fewer_than_four_points_or_none_that_agree_give_no_pose():
    K, points, pixels, _, _ = seen()
    assert pose_from_points(points[:3], pixels[:3], K, threshold=THRESHOLD, seed=0) is None
    assert pose_from_points(points[:0], pixels[:0], K, threshold=THRESHOLD, seed=0) is None
    assert pose_from_points(points, np.full_like(pixels, np.nan), K, threshold=THRESHOLD, seed=0) is None
    nowhere = np.random.default_rng(0).uniform(0, 400, size=(12, 2))
    found = pose_from_points(points[:12], nowhere, K, threshold=0.5, seed=0)
    assert found is None or found.count < 7


def test_points_in_one_place_give_no_traceback():
    K, points, pixels, _, _ = seen()
    same = np.repeat(points[:1], 20, 0)
    pose_from_points(same, np.repeat(pixels[:1], 20, 0), K, threshold=THRESHOLD, seed=0)
    pose_from_points(np.zeros((20, 3)), pixels[:20], K, threshold=THRESHOLD, seed=0)


def test_a_good_start_wins_where_sampling_has_too_little():
    K, points, pixels, R, t = seen(noise=0.2)
    random = np.random.default_rng(1)
    wrong = np.arange(len(points)) >= 6
    pixels[wrong] = random.uniform(0, 480, size=(wrong.sum(), 2))
    found = pose_from_points(points, pixels, K, (R, t), threshold=THRESHOLD, seed=0)
    assert found is not None
    assert found.inliers[:6].all()
    assert degrees_between(found.R, R)[0] < 5.0


def test_a_far_start_does_not_hurt():
    K, points, pixels, R, _ = seen(noise=0.2)
    found = pose_from_points(
        points, pixels, K, (np.diag([1.0, -1, -1]), np.array([0, 0, 9.0])), threshold=1, seed=0
    )
    assert found is not None
    assert degrees_between(found.R, R)[0] < 1.0


def test_refinement_reaches_the_exact_pose_from_ten_degrees_away():
    K, points, pixels, R, t = seen()
    start = (
        part[0] for part in apply_pose_steps(R[None], t[None], np.array([[0.1, -0.1, 0.3, 0.1, -0.1, 0.1]]))
    )
    fit = pose_of_tracks(points, pixels, None, K, *start, scale=2.0, iterations=30)
    assert degrees_between(fit.R, R)[0] < 1e-5
    assert np.allclose(fit.t, t, atol=1e-6)
    assert fit.cost < 1e-12


def test_refinement_is_never_worse_than_its_start():
    K, points, pixels, R, t = seen(noise=1.0)
    for degrees in (5.0, 60.0, 170.0):
        turned, shifted = (
            part[0] for part in apply_pose_steps(R[None], t[None], np.radians([[0, 0, 0, 0, degrees, 0]]))
        )
        before = point_equations(points, pixels, None, K, turned, shifted, 1.0)
        assert pose_of_tracks(points, pixels, None, K, turned, shifted, 1.0).cost <= before.cost


def test_the_gradient_is_the_finite_difference_of_the_cost_and_the_matrix_its_slope_without_residual():
    K, points, pixels, R, t = seen()

    def at(step, target=pixels):
        R_new, t_new = (part[0] for part in apply_pose_steps(R[None], t[None], np.asarray(step)[None]))
        return point_equations(points, target, None, K, R_new, t_new, 2.0)

    noisy = pixels + np.random.default_rng(0).normal(size=pixels.shape)
    for d in 1e-6 * np.eye(6):
        finite = (at(d, noisy).cost - at(-d, noisy).cost) / 2e-6
        assert finite == pytest.approx(at(np.zeros(6), noisy).gradient @ d / 1e-6, rel=1e-4, abs=1e-6)
        slope = (at(d).gradient - at(-d).gradient) / 2e-6
        assert np.allclose(
            at(np.zeros(6)).matrix @ d / 1e-6, slope, rtol=1e-3, atol=1e-3 * np.abs(slope).max()
        )


def test_the_equations_step_like_the_renderers():
    """Their numbers, handed to the renderer's equations, lead to the true pose."""
    K, points, pixels, R, t = seen()
    off = np.array([0.02, -0.03, 0.05, 0.02, -0.01, 0.03])
    R_off, t_off = (part[0] for part in apply_pose_steps(R[None], t[None], off[None]))
    for _ in range(4):
        own = point_equations(points, pixels, None, K, R_off, t_off, 5.0)
        theirs = NormalEquations(
            torch.tensor(own.matrix)[None], torch.tensor(own.gradient)[None], torch.tensor([own.cost])
        )
        R_off, t_off = (part[0] for part in apply_pose_steps(R_off[None], t_off[None], theirs.step().numpy()))
    assert degrees_between(R_off, R)[0] < 1e-4


def test_the_cost_is_the_weighted_mean_of_the_cauchy_loss():
    K, points, pixels, R, t = seen()
    pixels = pixels[:2] + np.array([[3.0, 4.0], [0.0, 2.0]])
    equations = point_equations(points[:2], pixels, np.array([3.0, 1.0]), K, R, t, 5.0)
    assert equations.cost == pytest.approx((3 * np.log(2) + np.log(1 + 4 / 25)) / 4)
    assert np.allclose(equations.details, [5.0, 2.0])


def test_without_points_the_equations_are_zero_and_the_pose_stays():
    K, points, pixels, R, t = seen()
    none = point_equations(points[:0], pixels[:0], None, K, R, t, 1.0)
    assert none.cost == 0.0
    assert not none.matrix.any() and not none.gradient.any()
    fit = pose_of_tracks(points, np.full_like(pixels, np.nan), None, K, R, t, 1.0)
    assert np.allclose(fit.R, R) and np.allclose(fit.t, t)


def test_points_behind_the_camera_are_charged_and_do_not_pull():
    K, points, pixels, R, t = seen()
    points = points.copy()
    points[0] = -2 * (R.T @ t)
    equations = point_equations(points, pixels, None, K, R, t, 1.0)
    assert equations.cost > 0.05
    assert np.isnan(equations.details[0])
    assert np.allclose(equations.gradient, 0, atol=1e-6)
