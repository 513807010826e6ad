"""Factorization: what affine views tell about depth, and what they leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracked_solids import degrees_between, intrinsics, scene

from tracking3d.estimation.online.initialization.structure_from_motion import (
    affine_motion,
    align_with_axis,
    assumed_relief,
    measured_relief,
    metric_structure,
)
from tracking3d.points.bundle_adjustment.adjustment import Structure
from tracking3d.points.bundle_adjustment.reprojection import project_camera_points, transform_to_camera


def far_away(frames: int, **settings):
    """Tracks of the points seen in all frames, through so long a lens that there is no perspective."""
    given = scene(frames, fov=0.5, **settings)
    common = given.tracks.visible.all(0)
    truth = replace(given.truth, points=given.truth.points[common])
    return given.K, truth, given.tracks.pixels[:, common]


def solved(K, truth, pixels, depth) -> Structure:
    affine = affine_motion(pixels, K, 3.0, 0)
    assert affine is not None
    z0 = float(np.mean(transform_to_camera(truth.R[0], truth.t[0], truth.points)[:, 2]))
    return metric_structure(affine, depth(affine), truth.t[0], z0)


@pytest.mark.parametrize("frames", [3, 8])
def test_three_views_without_perspective_give_the_motion_or_its_reversal(frames):
    K, truth, pixels = far_away(frames)
    ways = [
        solved(K, truth, pixels, lambda affine, sign=sign: tuple(sign * x for x in measured_relief(affine)))
        for sign in (1, -1)
    ]
    errors = [degrees_between(way.R, truth.R).max() for way in ways]
    assert min(errors) < 0.5
    assert max(errors) > 20
    right = ways[int(np.argmin(errors))]
    assert np.corrcoef(right.points[:, 2], truth.points[:, 2])[0, 1] > 0.999
    # Both are seen at the same places.
    for way in ways:
        away = np.linalg.norm(
            project_camera_points(transform_to_camera(way.R, way.t, way.points), K) - pixels, axis=-1
        )
        assert np.median(away) < 0.5


def test_frame_0_keeps_its_pose():
    K, truth, pixels = far_away(4)
    found = solved(K, truth, pixels, measured_relief)
    assert np.allclose(found.R[0], np.eye(3), atol=1e-9)
    assert np.allclose(found.t[0], truth.t[0])


def test_two_views_leave_the_amount_of_relief_open():
    K, truth, pixels = far_away(2)
    affine = affine_motion(pixels, K, 3.0, 0)
    assert affine is not None
    assert measured_relief(affine) is None
    turns = []
    for c in (0.3, 0.6, 1.2):
        found = solved(K, truth, pixels, lambda affine, c=c: assumed_relief(affine, c))
        away = np.linalg.norm(
            project_camera_points(transform_to_camera(found.R, found.t, found.points), K) - pixels, axis=-1
        )
        assert np.median(away) < 0.5
        turns.append(degrees_between(found.R[1], found.R[0])[0])
    assert turns[0] > 1.5 * turns[1] > 2 * turns[2]


def test_an_object_far_from_the_axis_is_no_harder():
    K = intrinsics(20.0)
    given = scene(5, fov=20.0)
    common = given.tracks.visible.all(0)
    truth = replace(given.truth, points=given.truth.points[common])
    aside = truth.t + np.array([0.3, 0.2, 0.0]) * truth.t[0, 2]
    pixels = project_camera_points(transform_to_camera(truth.R, aside, truth.points), K)
    errors = []
    for sign in (1, -1):
        moved_aside = replace(truth, t=aside)
        depth = lambda affine, sign=sign: tuple(sign * x for x in measured_relief(affine))  # noqa: E731
        errors.append(degrees_between(solved(K, moved_aside, pixels, depth).R, truth.R).max())
    assert min(errors) < 4.0


def test_points_that_jump_about_are_not_among_the_inliers():
    given = scene(6, noise=0.2, turn=15)
    pixels = given.tracks.pixels[:, given.tracks.visible.all(0)]
    random = np.random.default_rng(0)
    wrong = random.random(pixels.shape[1]) < 0.3
    pixels[:, wrong] += 6 * random.normal(size=(6, wrong.sum(), 2))
    affine = affine_motion(pixels, given.K, 2.0, 0)
    assert affine is not None
    assert affine.inliers[~wrong].mean() > 0.9
    assert affine.inliers[wrong].mean() < 0.1


def test_a_plane_has_no_third_dimension_and_a_solid_has():
    flat, solid = (
        affine_motion(given.tracks.pixels[:, given.tracks.visible.all(0)], given.K, 3.0, 0)
        for given in (scene(5, shape=shape, fov=10, turn=20) for shape in ("plane", "box"))
    )
    assert flat is not None and solid is not None
    assert flat.relief < 0.3 < 2 < solid.relief


def test_too_little_is_said():
    given = scene(4)
    common = np.flatnonzero(given.tracks.visible.all(0))
    assert affine_motion(given.tracks.pixels[:1, common], given.K, 3.0, 0) is None
    assert affine_motion(given.tracks.pixels[:, common[:5]], given.K, 3.0, 0) is None


@pytest.mark.parametrize("kind", ["one place", "one line", "standing still"])
def test_degenerate_points_give_no_traceback(kind):
    given = scene(4)
    pixels = given.tracks.pixels[:, given.tracks.visible.all(0)][:, :20]
    if kind == "one place":
        pixels = np.repeat(pixels[:, :1], 20, 1)
    elif kind == "one line":
        pixels = pixels[:, :1] + np.linspace(0, 50, 20)[:, None] * [1.0, 0.5]
    else:
        pixels = np.repeat(pixels[:1], 4, 0)
    affine = affine_motion(pixels, given.K, 3.0, 0)
    assert affine is None or np.isfinite(assumed_relief(affine, 0.5)).all()


def test_the_least_rotation_takes_a_direction_to_the_axis():
    direction = np.array([0.3, -0.2, 0.9])
    R = align_with_axis(direction)
    assert np.allclose(R @ direction, [0, 0, np.linalg.norm(direction)])
    assert np.allclose(R @ R.T, np.eye(3))
    angle = np.degrees(np.arccos(direction[2] / np.linalg.norm(direction)))
    assert degrees_between(R, np.eye(3))[0] == pytest.approx(angle)
