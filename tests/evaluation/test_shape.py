"""Chamfer distance and F-score of surfaces whose distance is known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d.geometry.alignment import ObjectAlignment
from tracking3d_bench.evaluation.shape import shape_scores

SAMPLES = 10_000


def sphere(radius=1.0, subdivisions=3):
    return trimesh.creation.icosphere(subdivisions, radius)


def sheet(height, size=1.0):
    """A square of side ``size`` at z = ``height``."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * size + [0, 0, height]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def test_a_shape_is_itself():
    scores = shape_scores(sphere(), sphere(), 2.0, samples=SAMPLES)
    assert scores.chamfer == pytest.approx(0, abs=1e-3)
    assert scores.precision == scores.recall == scores.f_score == 1.0


@pytest.mark.parametrize("distance", [0.019, 0.021, 0.3])
def test_parallel_sheets_are_as_far_apart_as_they_are(distance):
    scores = shape_scores(sheet(0.0), sheet(distance), 1.0, samples=SAMPLES)
    assert scores.chamfer == pytest.approx(distance, rel=2e-2)
    assert scores.f_score == (1.0 if distance < 0.02 else 0.0)


@pytest.mark.parametrize("factor", [0.9, 1.2])
def test_a_sphere_of_another_size_is_off_by_the_difference_of_radii(factor):
    scores = shape_scores(sphere(factor, 4), sphere(1.0, 4), 2.0, samples=SAMPLES)
    assert scores.chamfer == pytest.approx(abs(factor - 1) / 2, rel=0.03)


def test_figures_do_not_depend_on_the_unit():
    first = shape_scores(sphere(1.1), sphere(1.0), 2.0, samples=SAMPLES)
    second = shape_scores(sphere(1100.0), sphere(1000.0), 2000.0, samples=SAMPLES)
    assert second.chamfer == pytest.approx(first.chamfer, rel=1e-9)


def test_half_of_a_surface_is_precise_and_recalls_half():
    half = sheet(0.0)
    half.apply_transform(np.diag([0.5, 1, 1, 1]))
    scores = shape_scores(half, sheet(0.0), 1.0, samples=SAMPLES)
    assert scores.precision == 1.0
    # And of the other half the two hundredths beside the edge.
    assert scores.recall == pytest.approx(0.52, abs=0.02)
    assert scores.f_score == pytest.approx(2 * scores.recall / (1 + scores.recall))
    # Half is on it, the other half up to 0.5 away: a quarter of one half on average, and nothing the other way.
    assert scores.chamfer == pytest.approx(0.25 / 2 / 2, abs=0.005)


def test_large_and_small_faces_are_sampled_by_area():
    small = sheet(5.0, 0.01)
    both = trimesh.util.concatenate([sheet(0.0), *[small] * 100])  # a hundredth of the area
    scores = shape_scores(both, sheet(0.0), 1.0, samples=SAMPLES)
    assert scores.precision == pytest.approx(1 / 1.01, abs=0.004)


def test_the_similarity_carries_the_estimate_into_the_true_frame():
    A = Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix()
    alignment = ObjectAlignment(A, 3.0, np.array([1.0, -2.0, 0.5]))
    true = trimesh.creation.box((1.0, 2.0, 3.0))
    estimated = true.copy().apply_transform(np.linalg.inv(alignment.T_true_est))
    diameter = 14**0.5
    scores = shape_scores(estimated, true, diameter, alignment.T_true_est, samples=SAMPLES)
    assert scores.chamfer == pytest.approx(0, abs=1e-3)
    assert shape_scores(estimated, true, diameter, samples=SAMPLES).chamfer > 0.1


def test_the_meshes_stay_as_they_are():
    mesh = sphere()
    before = mesh.vertices.copy()
    shape_scores(mesh, sphere(), 2.0, np.diag([2.0, 2.0, 2.0, 1.0]), samples=100)
    np.testing.assert_array_equal(mesh.vertices, before)


def test_scores_are_repeatable_and_depend_on_the_seed_little():
    one, other = sphere(1.05), trimesh.creation.box((1.5, 1.5, 1.5))
    first = shape_scores(one, other, 2.0, samples=SAMPLES, seed=1)
    assert shape_scores(one, other, 2.0, samples=SAMPLES, seed=1) == first
    second = shape_scores(one, other, 2.0, samples=SAMPLES, seed=2)
    assert second != first
    assert second.chamfer == pytest.approx(first.chamfer, rel=0.03)


def test_distances_are_those_of_points_to_triangles():
    # A coarse mesh against its own points, moved outwards along the normals of its faces.
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    grown = trimesh.creation.box((1.2, 1.2, 1.2))
    scores = shape_scores(grown, box, 3**0.5, samples=40_000)
    points, _ = trimesh.sample.sample_surface(grown, 40_000, seed=9)
    outwards = np.linalg.norm(np.maximum(np.abs(points) - 0.5, 0), axis=1).mean()
    assert scores.chamfer * 3**0.5 == pytest.approx((outwards + 0.1) / 2, rel=0.01)


@pytest.mark.parametrize("diameter", [0.0, -1.0, np.nan, np.inf])
def test_a_diameter_that_is_not_positive_is_refused(diameter):
    with pytest.raises(ValueError, match="diameter needs to be positive"):
        shape_scores(sphere(), sphere(), diameter)


def test_meshes_without_a_surface_are_refused():
    flat = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)
    nothing = trimesh.Trimesh()
    broken = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], process=False)
    for mesh in (flat, nothing, broken):
        with pytest.raises(ValueError, match="the estimated mesh has the area"):
            shape_scores(mesh, sphere(), 2.0)
        with pytest.raises(ValueError, match="the true mesh has the area"):
            shape_scores(sphere(), mesh, 2.0)


def test_a_similarity_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"\(4, 4\), got \(3, 4\)"):
        shape_scores(sphere(), sphere(), 2.0, np.eye(4)[:3])


def test_what_was_not_seen_can_be_left_out():
    wrong_behind = sphere()
    vertices = wrong_behind.vertices.copy()
    vertices[vertices[:, 2] > 0] *= 1.2
    wrong_behind = trimesh.Trimesh(vertices, wrong_behind.faces, process=False)
    scores = shape_scores(
        wrong_behind, sphere(), 2.0, samples=SAMPLES, seen=lambda points, normals: points[:, 2] < -0.1
    )
    assert min(scores.f_score_seen, scores.f_score_fine_seen) > 0.995
    assert scores.f_score < 0.7
    assert shape_scores(sphere(), sphere(), 2.0, samples=SAMPLES).f_score_seen is None


def test_a_handle_is_counted_and_a_wrong_normal_shows():
    ring = trimesh.creation.torus(1.0, 0.3)
    scores = shape_scores(sphere(), ring, 2.6, samples=SAMPLES)
    assert scores.genus_error == 1 and shape_scores(ring, ring, 2.6, samples=SAMPLES).genus_error == 0
    assert shape_scores(sheet(0.0), ring, 2.6, samples=SAMPLES).genus_error is None
    inside_out = sphere()
    inside_out.invert()
    assert shape_scores(inside_out, sphere(), 2.0, samples=SAMPLES).normals < -0.99
