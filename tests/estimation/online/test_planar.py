"""Flat objects are recognised and keep to a plane; which way it tilts is found where perspective tells."""

from __future__ import annotations

import numpy as np
import pytest
from tracked_solids import degrees_between, scene

from tracking3d.estimation.online.initialization.structure_from_motion import (
    _fit_plane_structure,
    is_planar,
    planar_structures,
    resect_views,
)
from tracking3d.points.bundle_adjustment.adjustment import Tracks


def flat_scene(**settings):
    return scene(shape="plane", **{"frames": 5, **settings})


def structures(given):
    return planar_structures(given.tracks, given.K, given.truth.t[0], float(given.truth.t[0, 2]), 1.0)


def test_a_plane_looks_flat_and_a_turned_solid_does_not():
    given = flat_scene(noise=0.3, outliers=0.2)
    assert is_planar(given.tracks, given.K, 1.0)
    for shape in ("ellipsoid", "box"):
        solid = scene(4, shape=shape, noise=0.3, turn=12)
        common = solid.tracks.visible.all(0)
        tracks = Tracks(solid.tracks.pixels[:, common], solid.tracks.visible[:, common])
        assert not is_planar(tracks, solid.K, 1.0)


@pytest.mark.parametrize("fov", [25.0, 45.0])
def test_exact_tracks_of_a_plane_give_the_exact_motion(fov):
    given = flat_scene(fov=fov)
    best = structures(given)[0]
    assert best.origin == "flat"
    assert degrees_between(best.R, given.truth.R).max() < 0.1
    assert np.linalg.svd(best.points - best.points.mean(0))[1][2] < 1e-6


def test_the_tilt_is_refined_from_a_wrong_one():
    given = flat_scene()
    rays = (
        np.concatenate([given.tracks.pixels[0] - given.K[:2, 2], np.full((80, 1), given.K[0, 0])], 1)
        / given.K[0, 0]
    )
    t0 = given.truth.t[0]
    found = _fit_plane_structure(given.tracks, given.K, rays, np.array([0.1, 0.1]), t0, float(t0[2]), 1.0)
    assert degrees_between(found.R, given.truth.R).max() < 0.5


def test_noise_and_sliding_points_cost_little():
    given = flat_scene(noise=0.3, outliers=0.2, frames=6, seed=2)
    assert degrees_between(structures(given)[0].R, given.truth.R).max() < 3.0


def test_without_perspective_several_tilts_that_fit_alike_are_given():
    given = flat_scene(fov=5.0, noise=0.2)
    found = structures(given)
    normals = [np.linalg.svd(one.points - one.points.mean(0))[2][2] for one in found]
    tilts = np.array([normal[:2] / normal[2] for normal in normals])
    alike = np.array([one.cost for one in found]) < 1.1 * found[0].cost
    assert np.ptp(tilts[alike], axis=0).max() > 0.3


def test_poses_come_from_points_frame_by_frame():
    given = flat_scene()
    found = resect_views(given.tracks, given.K, given.truth.points, given.truth.t[0], 1.0)
    assert degrees_between(found.R, given.truth.R).max() < 1e-3


def test_points_in_one_place_are_no_traceback():
    pixels = np.full((3, 10, 2), 200.0)
    given = flat_scene(frames=3)
    tracks = Tracks(pixels, np.ones((3, 10), bool))
    is_planar(tracks, given.K, 1.0)
    planar_structures(tracks, given.K, given.truth.t[0], 6.0, 1.0)
