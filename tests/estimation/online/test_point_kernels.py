"""The compiled kernels of points and poses against slow and obvious twins in NumPy."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
from tracked_solids import disturbed, scene
from twins import bundle_adjustment, pose_from_points

from tracking3d.estimation.online.optimization.pnp import pose_of_tracks
from tracking3d.points.bundle_adjustment.adjustment import AdjustmentProblem, System, adjust
from tracking3d.rendering.kernels.compilation import get_num_threads, set_num_threads

SCENES = {
    "a few points": {"frames": 4, "count": 9, "noise": 0.5},
    "many": {"frames": 12, "count": 150, "noise": 0.3, "outliers": 0.2},
    "long": {"frames": 41, "count": 70, "noise": 0.3},
    "flat": {"frames": 5, "count": 40, "shape": "plane", "noise": 0.1},
}
every_scene = pytest.mark.parametrize("settings", SCENES.values(), ids=SCENES)


@pytest.fixture
def by_twins(monkeypatch):
    """Call a function with the kernels of bundle adjustment replaced by their twins."""

    def call(function):
        with monkeypatch.context() as patch:
            patch.setattr(AdjustmentProblem, "evaluate", bundle_adjustment.evaluated)
            patch.setattr(AdjustmentProblem, "linearize", bundle_adjustment.linearised)
            patch.setattr(System, "step", bundle_adjustment.step)
            return function()

    return call


def posed(given, fixed, free_focal):
    """A problem with a weight of its own for each observation, a prior, and a point behind the camera."""
    random = np.random.default_rng(3)
    weight = given.tracks.weights() * random.uniform(0.1, 2, given.tracks.visible.shape)
    at = disturbed(given.truth)
    at.points[1] = [0, 0, -50]
    prior = given.truth.points + 0.1
    weights = random.uniform(0, 0.3, len(prior))
    pixels = np.nan_to_num(given.tracks.pixels)
    return AdjustmentProblem(pixels, weight, given.K, fixed, 2.0, free_focal, prior, weights), replace(
        at, focal_factor=1.1
    )


@every_scene
@pytest.mark.parametrize(("fixed", "free_focal"), [(0, False), (1, False), (1, True), (2, True)])
def test_cost_residuals_equations_and_step_of_a_bundle(settings, fixed, free_focal):
    problem, at = posed(scene(**settings), fixed, free_focal)
    mine, expected = problem.evaluate(at), bundle_adjustment.evaluated(problem, at)
    assert mine.cost == pytest.approx(expected.cost, rel=1e-12)
    np.testing.assert_allclose(mine.residual, expected.residual, rtol=1e-9, atol=1e-9)
    mine, expected = problem.linearize(at), bundle_adjustment.linearised(problem, at)
    for field in fields(mine):
        values = getattr(expected, field.name)
        np.testing.assert_allclose(
            getattr(mine, field.name), values, rtol=1e-9, atol=1e-9 * np.abs(values).max(), err_msg=field.name
        )
    for damping in (1e-3, 10.0):
        mine, wanted = expected.step(damping), bundle_adjustment.step(expected, damping)
        for part, values in zip(mine, wanted, strict=True):
            np.testing.assert_allclose(part, values, rtol=1e-6, atol=1e-6 * np.abs(values).max())


@every_scene
def test_an_adjustment_ends_in_the_same_place(by_twins, settings):
    given = scene(**settings)
    adjusted = partial(adjust, given.tracks, given.K, disturbed(given.truth), iterations=40)
    mine, expected = adjusted(), by_twins(adjusted)
    assert mine.cost == pytest.approx(expected.cost, rel=1e-5)
    np.testing.assert_allclose(mine.R, expected.R, atol=2e-3)


def test_threads_change_no_digit_of_a_step():
    problem, at = posed(scene(frames=41, count=70), 1, True)
    system = problem.linearize(at)
    before, steps = get_num_threads(), []
    for threads in (1, 2, 5):
        set_num_threads(threads)
        try:
            steps.append(system.step(1e-3))
        finally:
            set_num_threads(before)
    for other in steps[1:]:
        np.testing.assert_array_equal(steps[0][0], other[0])
        np.testing.assert_array_equal(steps[0][1], other[1])


def test_equations_that_are_not_finite_give_no_step():
    problem, at = posed(scene(), 1, False)
    system = problem.linearize(at)
    for broken in (
        replace(system, poses=np.full_like(system.poses, np.nan)),
        replace(system, points_gradient=np.full_like(system.points_gradient, np.inf)),
    ):
        with np.errstate(invalid="ignore"):
            assert broken.step(1e-3) is None and bundle_adjustment.step(broken, 1e-3) is None


@every_scene
def test_the_pose_of_tracks(settings):
    given = scene(**settings)
    points, pixels = given.truth.points.copy(), given.tracks.pixels[2].copy()
    points[0], pixels[1], points[2] = np.nan, np.inf, [0, 0, -90]
    weight = np.random.default_rng(0).uniform(0, 1, len(points))
    weight[3], weight[4] = 0, np.nan
    start = given.truth.R[0].copy(), given.truth.t[0].copy()
    for iterations in (0, 1, 30):
        mine, expected = (
            fit(points, pixels, weight, given.K, *start, 2.0, iterations)
            for fit in (pose_of_tracks, pose_from_points.pose_of_tracks)
        )
        np.testing.assert_allclose(mine.R, expected.R, atol=1e-5)
        np.testing.assert_allclose(mine.t, expected.t, atol=1e-5)
        assert mine.cost == pytest.approx(expected.cost, rel=1e-6)
        for name in ("matrix", "gradient", "details"):
            values = getattr(expected, name)
            near = 1e-4 * np.nanmax(np.abs(expected.matrix))
            np.testing.assert_allclose(getattr(mine, name), values, atol=near, err_msg=name)
    np.testing.assert_array_equal(start[0], given.truth.R[0])
    np.testing.assert_array_equal(start[1], given.truth.t[0])
