"""Structure without a start: the truth is among the few hypotheses, and so is its reversal in depth."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tracked_solids import degrees_between, intrinsics, scene

from tracking3d.estimation.online.initialization.structure_from_motion import (
    image_deformation,
    register_all,
    structure_hypotheses,
)
from tracking3d.points.bundle_adjustment.adjustment import Tracks, adjust


def errors(found, given) -> list[float]:
    """Worst rotation error of every hypothesis."""
    return [float(degrees_between(one.R, given.truth.R).max()) for one in found]


def hypotheses(given, **settings):
    return structure_hypotheses(given.tracks, given.K, given.truth.t[0], **settings)


@pytest.mark.parametrize("shape", ["ellipsoid", "box"])
def test_perspective_views_without_noise_give_the_exact_structure_first(shape):
    given = scene(6, shape=shape)
    found = hypotheses(given)
    assert found[0].cost < 1e-6
    assert errors(found, given)[0] < 0.05
    assert all(a.cost <= b.cost for a, b in pairwise(found))


@pytest.mark.parametrize("fov", [10.0, 45.0])
@pytest.mark.parametrize("shape", ["ellipsoid", "box"])
def test_noise_and_outliers_leave_a_good_one_among_the_best_few(shape, fov):
    given = scene(5, shape=shape, fov=fov, noise=0.3, outliers=0.2, turn=25, seed=4)
    found = hypotheses(given)
    assert len(found) <= 4
    assert min(errors(found, given)) < 3.0


def test_two_views_are_enough_where_there_is_perspective():
    given = scene(2, turn=15, noise=0.2)
    assert errors(hypotheses(given), given)[0] < 3.0


def test_without_perspective_the_reversal_is_there_and_fits_nearly_as_well():
    given = scene(4, fov=5, noise=0.3, turn=25)
    found = hypotheses(given)
    assert min(errors(found, given)) < 2.0
    reversed_motion = np.stack([np.diag([1.0, 1, -1]) @ R @ np.diag([1.0, 1, -1]) for R in given.truth.R])
    apart = [degrees_between(one.R, reversed_motion).max() for one in found]
    assert min(apart) < 5.0
    partner = found[int(np.argmin(apart))]
    assert partner.cost < 1.2 * found[0].cost


def test_hypotheses_differ_from_each_other_and_keep_frame_0():
    given = scene(4, fov=10, noise=0.3, turn=20)
    found = hypotheses(given)
    for n, one in enumerate(found):
        assert np.allclose(one.R[0], np.eye(3), atol=1e-12)
        assert np.allclose(one.t[0], given.truth.t[0])
        for other in found[n + 1 :]:
            assert degrees_between(one.R, other.R).max() > 2.0
    assert all(one.origin for one in found)


def test_points_that_come_later_and_frames_that_share_none_with_the_first_are_solved_too():
    given = scene(12, count=150, turn=110, noise=0.1)
    seen = given.tracks.visible
    assert not (seen[0] & seen[-1]).sum() > 20
    found = hypotheses(given)[0]
    assert degrees_between(found.R, given.truth.R).max() < 3.0
    assert np.isfinite(found.points).all(1).mean() > 0.95
    assert found.residual.shape == seen.shape


def test_the_answer_depends_on_nothing_but_its_arguments():
    given = scene(4, noise=0.3)
    first, again = hypotheses(given), hypotheses(given)
    assert all(np.array_equal(a.R, b.R) and a.cost == b.cost for a, b in zip(first, again, strict=True))


def test_a_flat_object_is_kept_flat_and_its_motion_is_right():
    given = scene(5, shape="plane", noise=0.3, outliers=0.1)
    best = hypotheses(given)[0]
    assert best.origin == "flat"
    assert degrees_between(best.R, given.truth.R).max() < 3.0
    points = best.points - best.points.mean(0)
    assert np.linalg.svd(points)[1][2] < 0.02 * np.linalg.svd(points)[1][0]


def test_a_solid_that_has_turned_is_not_called_flat():
    for shape in ("ellipsoid", "box"):
        found = hypotheses(scene(5, shape=shape, noise=0.3, turn=25))
        assert all(one.origin != "flat" for one in found)


def test_the_wrong_lens_costs_more_than_the_right_one():
    given = scene(8, fov=25, noise=0.3)
    costs = {}
    for fov in (10, 25, 45, 65):
        K = intrinsics(fov)
        t0 = given.truth.t[0] * [1, 1, K[0, 0] / given.K[0, 0]]
        costs[fov] = structure_hypotheses(given.tracks, K, t0)[0].cost
    assert min(costs, key=costs.__getitem__) == 25


@pytest.mark.parametrize("fov", [25.0, 45.0, 65.0])
def test_a_freed_lens_is_found_from_the_next_candidate(fov):
    given = scene(8, fov=fov, noise=0.3)
    K = intrinsics(45.0 if fov != 45 else 25.0)
    t0 = given.truth.t[0] * [1, 1, K[0, 0] / given.K[0, 0]]
    best = structure_hypotheses(given.tracks, K, t0)[0]
    freed = adjust(given.tracks, K, best, free_focal=True, iterations=40)
    assert K[0, 0] * freed.focal_factor == pytest.approx(given.K[0, 0], rel=0.1)


def test_no_motion_and_similarities_are_not_enough_motion():
    given = scene(2, turn=0)
    still = given.tracks.pixels[[0, 0]]
    both = given.tracks.visible[[0, 0]]
    assert image_deformation(Tracks(still, both)) == pytest.approx(0, abs=1e-9)
    angle = np.radians(30)
    turned = 1.3 * still[1] @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]) + 5
    assert image_deformation(Tracks(np.stack([still[0], turned]), both)) == pytest.approx(0, abs=1e-9)


def test_more_turning_is_more_motion_whatever_the_size_and_the_outliers():
    small, medium, large = (image_deformation(scene(3, turn=turn).tracks) for turn in (3, 10, 30))
    assert small < 0.02 < 0.03 < medium < 0.06 < large
    tracks = scene(3, turn=10).tracks
    assert image_deformation(replace(tracks, pixels=3 * tracks.pixels)) == pytest.approx(medium)
    sliding = tracks.pixels.copy()
    sliding[1:, ::3] += 60
    assert image_deformation(replace(tracks, pixels=sliding)) == pytest.approx(medium, rel=0.5)


def test_too_little_to_see_gives_no_hypothesis_and_no_motion():
    given = scene(4)
    none = np.zeros_like(given.tracks.visible)
    few = none.copy()
    few[:, np.flatnonzero(given.tracks.visible.all(0))[:4]] = True
    apart = none.copy()
    apart[0, :10] = apart[1, 20:30] = True
    for visible in (none, few, apart):
        tracks = replace(given.tracks, visible=visible)
        assert structure_hypotheses(tracks, given.K, given.truth.t[0]) == []
        assert image_deformation(tracks) == 0.0
    one = Tracks(given.tracks.pixels[:1], given.tracks.visible[:1])
    assert structure_hypotheses(one, given.K, given.truth.t[0]) == []


def test_a_frame_that_sees_nothing_has_its_neighbours_pose():
    given = scene(5, noise=0.1)
    visible = given.tracks.visible.copy()
    visible[3] = False
    found = structure_hypotheses(replace(given.tracks, visible=visible), given.K, given.truth.t[0])[0]
    assert np.isfinite(found.R).all() and np.isfinite(found.t).all()
    others = [0, 1, 2, 4]
    assert degrees_between(found.R[others], given.truth.R[others]).max() < 2.0


@pytest.mark.parametrize("kind", ["one place", "one line", "standing still", "random"])
def test_hostile_tracks_give_no_traceback_and_nothing_infinite(kind):
    given = scene(4)
    random = np.random.default_rng(0)
    pixels = np.nan_to_num(given.tracks.pixels, nan=200.0)[:, :30]
    if kind == "one place":
        pixels = np.full_like(pixels, 200.0)
    elif kind == "one line":
        pixels = np.broadcast_to(pixels[:, :1] + np.linspace(0, 50, 30)[:, None] * [1.0, 0.5], pixels.shape)
    elif kind == "standing still":
        pixels = np.repeat(pixels[:1], 4, 0)
    else:
        pixels = random.uniform(0, 480, pixels.shape)
    tracks = Tracks(pixels, np.ones(pixels.shape[:2], bool))
    for one in structure_hypotheses(tracks, given.K, given.truth.t[0]):
        assert np.isfinite(one.R).all() and np.isfinite(one.t).all() and np.isfinite(one.cost)


def test_a_core_of_frames_and_points_is_completed_to_all():
    given = scene(9, noise=0.1)
    frames = np.array([0, 2, 4])
    points = np.flatnonzero(given.tracks.visible[frames].all(0))[:20]
    truth = given.truth
    core = replace(truth, R=truth.R[frames], t=truth.t[frames], points=truth.points[points], origin="affine")
    whole = register_all(given.tracks, given.K, core, frames, points, 1.0)
    assert degrees_between(whole.R, truth.R).max() < 1.0
    assert np.isfinite(whole.points).all()
    assert whole.origin == "affine"
