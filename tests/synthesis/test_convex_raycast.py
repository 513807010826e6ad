"""Ray casting against distances and normals known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.testing.synthesis.convex_raycast import Ellipsoid, Polyhedron

AHEAD = np.array([[0.0, 0.0, 1.0]])


def test_a_box_is_hit_where_its_near_face_is():
    hits = Polyhedron.box((1.0, 2.0, 0.5)).cast(np.array([0.3, -0.4, -5.0]), 2 * AHEAD)
    assert hits.hit[0]
    assert hits.distance[0] == pytest.approx(2.25)  # 4.5 away in lengths of the direction
    assert hits.points[0] == pytest.approx([0.3, -0.4, -0.5])
    assert hits.normals[0] == pytest.approx([0, 0, -1])


def test_an_ellipsoid_is_hit_at_its_pole_with_the_gradient_as_normal():
    ellipsoid = Ellipsoid(np.array([1.0, 2.0, 0.5]))
    hits = ellipsoid.cast(np.array([0.5, 0.0, -5.0]), AHEAD)
    z = -0.5 * np.sqrt(1 - 0.25)
    gradient = np.array([0.5, 0, z / 0.25])
    assert hits.points[0] == pytest.approx([0.5, 0, z])
    assert hits.normals[0] == pytest.approx(gradient / np.linalg.norm(gradient))


@pytest.mark.parametrize("surface", [Polyhedron.box((1.0, 2.0, 0.5)), Ellipsoid(np.array([1.0, 2.0, 0.5]))])
def test_rays_beside_or_away_from_a_surface_miss_it(surface):
    rays = np.array([[0.3, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])
    assert not surface.cast(np.array([0.0, 0.0, -5.0]), rays).hit.any()


@pytest.mark.parametrize("chamfer", [0.0, 0.2, 0.5])
def test_hits_lie_on_the_polyhedron_in_front_of_everything_else(chamfer):
    solid = Polyhedron.box((0.6, 0.5, 0.7), chamfer)
    origin = np.array([0.4, -3.0, 2.0])
    rays = np.random.default_rng(0).normal(-origin, 0.5, (2000, 3))
    hits = solid.cast(origin, rays)
    points, hit = hits.points[hits.hit], hits.hit
    assert 300 < hit.sum() < 1900
    height = points @ solid.normals.T - solid.offsets
    assert height.max() == pytest.approx(0, abs=1e-12)
    assert np.abs(np.take_along_axis(height, hits.panel[hit][:, None], 1)).max() < 1e-12
    assert (np.einsum("ni,ni->n", hits.normals[hit], rays[hit]) < 0).all()
    # Brute force: a ray that misses is outside at every sampled distance.
    samples = origin + np.linspace(0.2, 2.0, 200)[:, None, None] * rays[~hit]
    assert not ((samples @ solid.normals.T) < solid.offsets - 1e-9).all(-1).any()


def test_a_full_chamfer_would_reach_the_centre_and_a_small_one_keeps_all_fourteen_planes():
    assert Polyhedron.box((1, 1, 1), 1.0).offsets.min() == 0
    assert Polyhedron.box((1, 1, 1), 0.2).panels == 14
    assert Polyhedron.box((1, 1, 1)).panels == 6


@pytest.mark.parametrize(
    "surface", [Polyhedron.box((0.6, 0.5, 0.7), 0.3), Ellipsoid(np.array([0.9, 0.7, 0.6]))]
)
def test_texture_coordinates_are_continuous_within_a_panel_and_inside_it(surface):
    rng = np.random.default_rng(1)
    origin = np.array([1.0, 2.0, -3.0])
    rays = rng.normal(-origin, 0.3, (500, 3))
    a, b = surface.cast(origin, rays), surface.cast(origin, rays + 1e-6)
    same = a.hit & b.hit & (a.panel == b.panel)
    assert same.sum() > 200
    assert ((a.uv[a.hit] >= 0) & (a.uv[a.hit] <= 1)).all()
    moved = np.linalg.norm(a.points - b.points, axis=1)[same]
    assert (np.linalg.norm(a.uv - b.uv, axis=1)[same] <= 10 * moved + 1e-12).all()
