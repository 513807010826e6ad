"""Bundle adjustment finds poses and points from a wrong start, as far as the tracks tell, and keeps the gauge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracked_solids import degrees_between, disturbed, scene

from tracking3d.geometry.levenberg_marquardt import damped
from tracking3d.points.bundle_adjustment.adjustment import AdjustmentProblem, Structure, Tracks, adjust
from tracking3d.points.bundle_adjustment.reprojection import transform_to_camera


def problem(given, fixed=1, free_focal=False, prior_weight=0.0):
    count = len(given.truth.points)
    pixels = np.nan_to_num(given.tracks.pixels)
    prior = given.truth.points + 0.1
    weights = np.full(count, prior_weight)
    return AdjustmentProblem(pixels, given.tracks.weights(), given.K, fixed, 2.0, free_focal, prior, weights)


def size_free_errors(found: Structure, truth: Structure) -> np.ndarray:
    """Distances of points after the one scaling about frame 0's camera that no image shows."""
    x, y = (transform_to_camera(s.R[0], s.t[0], s.points) for s in (found, truth))
    factor = np.median(y[:, 2]) / np.median(x[:, 2])
    return np.linalg.norm(factor * x - y, axis=1)


def test_exact_tracks_give_the_exact_poses_and_points():
    given = scene()
    found = adjust(given.tracks, given.K, disturbed(given.truth), iterations=40)
    assert found.cost < 1e-16
    assert degrees_between(found.R, given.truth.R).max() < 1e-5
    assert size_free_errors(found, given.truth).max() < 1e-6
    assert np.nanmax(found.residual) < 1e-6


def test_the_residual_is_nan_exactly_where_nothing_is_seen():
    given = scene()
    found = adjust(given.tracks, given.K, given.truth)
    assert not given.tracks.visible.all()
    assert np.array_equal(np.isnan(found.residual), ~given.tracks.visible)


def test_noise_of_a_third_of_a_pixel_costs_less_than_a_degree():
    given = scene(noise=0.3)
    found = adjust(given.tracks, given.K, disturbed(given.truth))
    assert degrees_between(found.R, given.truth.R).max() < 1.0
    assert 0.2 < np.nanmedian(found.residual) < 0.4


def test_three_in_ten_sliding_points_do_no_harm():
    given = scene(frames=8, noise=0.3, outliers=0.3)
    found = adjust(given.tracks, given.K, disturbed(given.truth, degrees=2, shift=0.05), iterations=40)
    assert given.outliers.mean() > 0.2
    assert degrees_between(found.R, given.truth.R).max() < 1.5
    away = np.nanmedian(found.residual, 0)
    assert away[given.outliers].mean() > 3 * away[~given.outliers].mean()


def test_the_gradient_is_the_finite_difference_of_the_cost():
    given = scene(frames=3, count=6, noise=1.0)
    for fixed, free_focal in ((1, False), (0, False), (1, True)):
        posed = problem(given, fixed, free_focal, prior_weight=0.3)
        at = replace(posed.evaluate(disturbed(given.truth)), focal_factor=1.1)
        system = posed.linearize(at)
        total = posed.weight.sum()

        def cost(d_poses, d_points, posed=posed, at=at, total=total):
            return total * posed.evaluate(posed.step_by(at, d_poses, d_points)).cost

        none, still = np.zeros(len(system.poses)), np.zeros_like(at.points)
        for k in range(len(none)):
            d = 1e-6 * np.eye(len(none))[k]
            finite = (cost(d, still) - cost(-d, still)) / 2e-6
            assert system.poses_gradient[k] == pytest.approx(finite, rel=1e-4, abs=1e-4)
        for n, k in ((0, 0), (2, 1), (4, 2)):
            d = np.zeros_like(at.points)
            d[n, k] = 1e-6
            finite = (cost(none, d) - cost(none, -d)) / 2e-6
            assert system.points_gradient[n, k] == pytest.approx(finite, rel=1e-4, abs=1e-4)


def test_the_matrix_is_gauss_newtons_at_small_residuals():
    """With hardly any residual the Hessian is J^T J, which finite differences of the gradient show."""
    given = scene(frames=3, count=5)
    posed = problem(given, free_focal=True)
    at = posed.evaluate(given.truth)
    system = posed.linearize(at)
    size = len(system.poses)
    for k in range(size):
        d = 1e-6 * np.eye(size)[k]
        ahead, back = (posed.linearize(posed.step_by(at, s * d, np.zeros_like(at.points))) for s in (1, -1))
        finite = (ahead.poses_gradient - back.poses_gradient) / 2e-6
        assert np.allclose(system.poses[k], finite, rtol=1e-3, atol=1e-3 * np.abs(system.poses).max())
        finite = (ahead.points_gradient - back.points_gradient) / 2e-6
        assert np.allclose(system.coupling[..., k], finite, rtol=1e-3, atol=1e-3 * np.abs(system.poses).max())


def test_eliminating_the_points_gives_the_step_of_the_whole_system():
    given = scene(frames=3, count=7, noise=0.5)
    system = problem(given).linearize(given.truth)
    size, count = len(system.poses), len(system.points)
    whole = np.zeros((size + 3 * count, size + 3 * count))
    whole[:size, :size] = damped(system.poses, 0.01)
    for n, block in enumerate(damped(system.points, 0.01)):
        rows = slice(size + 3 * n, size + 3 * n + 3)
        whole[rows, rows] = block
        whole[:size, rows] = system.coupling[n].T
        whole[rows, :size] = system.coupling[n]
    gradient = np.concatenate([system.poses_gradient, system.points_gradient.ravel()])
    step = system.step(0.01)
    assert step is not None
    d_poses, d_points = step
    assert np.allclose(
        np.concatenate([d_poses, d_points.ravel()]), np.linalg.solve(whole, -gradient), rtol=1e-6
    )


@pytest.mark.parametrize("fixed", [1, 3, 6])
def test_leading_frames_do_not_move(fixed):
    given = scene(noise=0.3)
    start = disturbed(given.truth)
    found = adjust(given.tracks, given.K, start, fixed=fixed)
    assert np.array_equal(found.R[:fixed], start.R[:fixed])
    assert np.allclose(found.t[:fixed], start.t[:fixed], atol=1e-12)
    assert found.cost < adjust(given.tracks, given.K, start, iterations=0).cost


def test_with_all_frames_fixed_points_are_triangulated_exactly():
    given = scene()
    start = replace(given.truth, points=given.truth.points + 0.2)
    found = adjust(given.tracks, given.K, start, fixed=6, iterations=40)
    assert np.allclose(found.points, given.truth.points, atol=1e-5)


def test_the_median_depth_in_frame_0_stays_that_of_the_start():
    given = scene(noise=0.3)
    start = disturbed(given.truth)
    farther = replace(start, points=start.points + np.array([0, 0, 0.5]))
    for one in (start, farther):
        found = adjust(given.tracks, given.K, one)
        assert np.median(found.points[:, 2]) == pytest.approx(np.median(one.points[:, 2]), abs=1e-9)


def test_it_is_never_worse_than_the_start():
    given = scene(noise=1.0, outliers=0.3)
    for seed in range(3):
        start = disturbed(given.truth, degrees=40, shift=0.6, seed=seed)
        before = adjust(given.tracks, given.K, start, iterations=0)
        assert adjust(given.tracks, given.K, start, iterations=5).cost <= before.cost


def test_a_weight_of_zero_is_the_same_as_not_seen():
    given = scene(noise=0.3)
    weight = np.ones(given.tracks.visible.shape)
    weight[3, :10] = 0
    hidden = given.tracks.visible.copy()
    hidden[3, :10] = False
    start = disturbed(given.truth)
    weighted = adjust(replace(given.tracks, weight=weight), given.K, start)
    unseen = adjust(replace(given.tracks, visible=hidden), given.K, start)
    assert np.allclose(weighted.R, unseen.R, atol=1e-12)
    assert weighted.cost == pytest.approx(unseen.cost)


def test_a_strong_prior_holds_points_where_they_should_be():
    given = scene(noise=0.3)
    prior = given.truth.points.copy()
    prior[::2] = np.nan
    found = adjust(
        given.tracks,
        given.K,
        disturbed(given.truth),
        point_prior=prior,
        point_prior_weight=1e6,
        iterations=40,
    )
    away = np.linalg.norm(found.points - given.truth.points, axis=1)
    assert away[1::2].max() < 1e-3
    assert away[::2].max() > 3e-3
    assert degrees_between(found.R, given.truth.R).max() < 0.5


def test_a_free_focal_length_is_found_from_twenty_percent_off():
    given = scene(frames=8, noise=0.1)
    wrong = given.K.copy()
    wrong[0, 0] *= 1.2
    wrong[1, 1] *= 1.2
    start = disturbed(replace(given.truth, t=given.truth.t * [1, 1, 1.2]), degrees=2, shift=0.05)
    found = adjust(given.tracks, wrong, start, free_focal=True, iterations=40)
    assert found.focal_factor == pytest.approx(1 / 1.2, rel=0.03)
    # The object keeps its size: the depth of frame 0 goes with the focal length.
    assert found.t[0, 2] == pytest.approx(start.t[0, 2] * found.focal_factor, rel=0.02)
    assert np.array_equal(found.R[0], start.R[0])
    held = adjust(given.tracks, wrong, start, iterations=40)
    assert held.focal_factor == 1.0
    assert held.cost > 1.1 * found.cost


def test_a_point_behind_the_camera_is_charged_and_the_others_carry_on():
    given = scene()
    start = disturbed(given.truth, degrees=2, shift=0.02)
    points = start.points.copy()
    points[0, 2] -= 100
    found = adjust(given.tracks, given.K, replace(start, points=points), iterations=40)
    assert degrees_between(found.R, given.truth.R).max() < 0.01
    assert found.cost > 0.01


def test_unknown_points_stay_unknown_and_the_rest_is_solved():
    given = scene()
    start = disturbed(given.truth)
    points = start.points.copy()
    points[:5] = np.nan
    found = adjust(given.tracks, given.K, replace(start, points=points), iterations=40)
    assert np.isnan(found.points[:5]).all()
    assert degrees_between(found.R, given.truth.R).max() < 1e-4


def test_what_is_not_finite_is_not_seen():
    given = scene()
    pixels = given.tracks.pixels.copy()
    pixels[2, 0], pixels[3, 1, 1] = np.nan, np.inf
    weight = np.ones(given.tracks.visible.shape)
    weight[4, 2], weight[1, 3] = np.nan, -1.0
    weights = Tracks(pixels, np.ones_like(given.tracks.visible), weight).weights()
    assert not weights[[2, 3, 4, 1], [0, 1, 2, 3]].any()
    found = adjust(
        Tracks(pixels, given.tracks.visible, weight), given.K, disturbed(given.truth), iterations=40
    )
    assert degrees_between(found.R, given.truth.R).max() < 1e-4


def test_with_nothing_seen_nothing_moves():
    given = scene()
    start = disturbed(given.truth)
    blind = replace(given.tracks, visible=np.zeros_like(given.tracks.visible))
    found = adjust(blind, given.K, start)
    assert np.allclose(found.R, start.R)
    assert np.allclose(found.points, start.points)
    assert found.cost == 0.0


def test_shapes_that_do_not_fit_are_refused():
    given = scene()
    with pytest.raises(ValueError, match="frames and points of the tracks"):
        adjust(given.tracks, given.K, replace(given.truth, points=given.truth.points[:-1]))
    with pytest.raises(ValueError, match="frames and points of the tracks"):
        adjust(given.tracks, given.K, given.truth, fixed=7)
