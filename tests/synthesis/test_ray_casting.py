"""Rays against meshes: where a sphere and a box are hit is known in closed form."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from tracking3d.errors import InputError
from tracking3d_bench.synthesis.ray_casting import RayMesh


def rays(count=2000, seed=0):
    """Rays from around a sphere of radius 4 to points within 1.3 of the origin."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(size=(count, 3))
    origins *= 4 / np.linalg.norm(origins, axis=1, keepdims=True)
    return origins, rng.uniform(-1.3, 1.3, (count, 3)) - origins


def entry_into_a_box(origins, directions, half):
    """Distance at which rays enter a box (slab method), infinite for those that miss."""
    with np.errstate(divide="ignore"):
        a, b = (-half - origins) / directions, (half - origins) / directions
    enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.where(enter < leave, enter, np.inf), leave - enter


def test_a_box_is_hit_at_the_distance_of_the_slab_method():
    half = np.array([0.6, 0.9, 0.4])
    origins, directions = rays()
    hits = RayMesh.of(trimesh.creation.box(2 * half)).cast(origins, directions)
    expected, thickness = entry_into_a_box(origins, directions, half)
    grazing = np.abs(thickness) < 1e-4
    assert (np.isfinite(expected) == (hits.face >= 0))[~grazing].all()
    hit = np.isfinite(expected) & ~grazing
    assert 500 < hit.sum() < 1900
    assert hits.distance[hit] == pytest.approx(expected[hit], abs=1e-9)
    assert np.isinf(hits.distance[hits.face < 0]).all()


def test_a_fine_sphere_is_hit_where_the_sphere_is_and_has_its_normals():
    surface = RayMesh.of(trimesh.creation.icosphere(5))
    origins, directions = rays()
    hits = surface.cast(origins, directions)
    a, b = (directions**2).sum(1), (origins * directions).sum(1)
    root = b**2 - a * ((origins**2).sum(1) - 1)
    clear = root > 0.2 * a  # not grazing, where the sphere's facets matter
    assert clear.sum() > 400 and (hits.face[clear] >= 0).all()
    expected = (-b[clear] - np.sqrt(root[clear])) / a[clear]
    assert hits.distance[clear] == pytest.approx(expected, abs=2e-3)
    normals = surface.normals(hits.face[clear], hits.weights[clear])
    points = origins[clear] + expected[:, None] * directions[clear]
    assert (normals * points).sum(1).min() > np.cos(np.radians(0.5))


def test_the_weights_give_the_point_that_is_hit():
    surface = RayMesh.of(trimesh.creation.icosphere(1))
    origins, directions = rays()
    hits = surface.cast(origins, directions)
    hit = hits.face >= 0
    assert hits.weights[hit].min() >= 0
    assert hits.weights[hit].sum(1) == pytest.approx(1)
    points = np.einsum("nc,ncd->nd", hits.weights[hit], surface.vertices[surface.faces[hits.face[hit]]])
    assert points == pytest.approx((origins + hits.distance[:, None] * directions)[hit], abs=1e-5)


@pytest.mark.parametrize("size", [1e-3, 1e3])
def test_precision_does_not_depend_on_the_unit(size):
    surface = RayMesh.of(trimesh.creation.box((2 * size, 2 * size, 2 * size)))
    hits = surface.cast(np.array([[0.1, 0.2, -5.0]]) * size, np.array([[0.0, 0.0, 1.0]]))
    assert hits.distance[0] == pytest.approx(4 * size, rel=1e-9)


def test_edges_of_a_box_stay_sharp_and_a_texture_seam_of_a_cylinder_does_not_show():
    box = RayMesh.of(trimesh.creation.box())
    assert box.corner_normals == pytest.approx(np.repeat(box.face_normals[:, None], 3, 1))
    cylinder = trimesh.creation.cylinder(1.0, 2.0, sections=32)
    split = trimesh.Trimesh(
        cylinder.triangles.reshape(-1, 3), np.arange(3 * len(cylinder.faces)).reshape(-1, 3), process=False
    )
    surface = RayMesh.of(split)
    side = np.abs(surface.face_normals[:, 2]) < 0.5
    radial = surface.vertices[surface.faces[side]] * (1, 1, 0)
    assert (surface.corner_normals[side] * radial).sum(2).min() > np.cos(np.radians(2.5))
    assert (
        np.abs(surface.face_normals[side, :2]).max() < 1 and (surface.corner_normals[~side, :, :2] == 0).all()
    )


def test_no_rays_meet_nothing():
    surface = RayMesh.of(trimesh.creation.box())
    none = np.zeros((0, 3))
    assert len(surface.cast(none, none).face) == 0 and len(surface.is_blocked(none, none)) == 0


def test_without_embree_one_sentence_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh.ray.ray_pyembree", None)
    with pytest.raises(InputError, match=r"pip install 'tracking3d\[synth\]'"):
        RayMesh.of(trimesh.creation.box())
