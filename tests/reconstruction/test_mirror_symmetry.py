"""Planes of symmetry of boxes, tetrahedra and balls of which a part was seen, and what is completed by them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from rendered_views import CAMERA, pose

from tracking3d.reconstruction.meshing import Grid
from tracking3d.reconstruction.mirror_completion import complete_by_symmetry
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane, find_symmetry_planes
from tracking3d.reconstruction.plane_sweep import Guide
from tracking3d.reconstruction.shape import mesh_distance
from tracking3d.reconstruction.views import shape_view
from tracking3d.scene.view import ObjectView

SIZE = np.array([1.6, 1.2, 1.0])
CORNER = np.array([1.0, 1.0, -1.0])  # of the box, towards a camera that looks along z


def surface(mesh: trimesh.Trimesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points spread over a surface, and its normals there."""
    points, face = trimesh.sample.sample_surface(mesh, 3000, seed=1)
    return np.asarray(points), np.asarray(mesh.face_normals)[face]


def corner_of_a_box() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Three of its faces."""
    points, normals = surface(trimesh.creation.box(SIZE))
    seen = normals @ CORNER > 0
    return points[seen], normals[seen]


def outside_of_the_box(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points) > SIZE / 2 + 0.03).any(1))


def test_three_faces_of_a_box_have_its_planes_of_symmetry():
    planes = find_symmetry_planes(*corner_of_a_box(), outside_of_the_box)
    assert len(planes) == 3
    normals = np.abs([plane.normal for plane in planes])
    np.testing.assert_allclose(normals.max(1), 1, atol=2e-3)
    assert sorted(normals.argmax(1)) == [0, 1, 2]
    np.testing.assert_allclose([plane.offset for plane in planes], 0, atol=0.02)
    assert all(0.5 <= plane.support < 0.95 for plane in planes)


def test_they_are_the_same_for_an_object_that_is_turned_and_larger():
    points, normals = corner_of_a_box()
    T = trimesh.transformations.rotation_matrix(1.0, [1, 2, 3])[:3, :3]

    def outside(asked: NDArray[np.float64]) -> NDArray[np.bool_]:
        return outside_of_the_box(asked @ T / 5)

    planes = find_symmetry_planes(5 * points @ T.T, normals @ T.T, outside)
    along = np.abs([plane.normal @ T for plane in planes])
    np.testing.assert_allclose(along.max(1), 1, atol=2e-3)


def test_a_mirror_image_that_frames_have_looked_at_and_not_seen_refutes_a_plane():
    def free_on_the_left(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return outside_of_the_box(points) | (points[:, 0] < -0.3)

    planes = find_symmetry_planes(*corner_of_a_box(), free_on_the_left)
    assert all(abs(plane.normal[0]) < 0.9 for plane in planes)


def test_a_solid_without_symmetry_has_no_plane():
    corners = np.array([[0, 0, 0], [2, 0, 0], [0.3, 1.2, 0], [1.5, 0.3, 0.9]])
    mesh = trimesh.convex.convex_hull(corners)

    def outside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        beyond = (points[:, None] - mesh.triangles_center) * mesh.face_normals
        return np.asarray((beyond.sum(2) > 0.03).any(1))

    assert find_symmetry_planes(*surface(mesh), outside) == []


def test_too_few_points_have_no_plane():
    points, normals = corner_of_a_box()
    assert find_symmetry_planes(points[:50], normals[:50], outside_of_the_box) == []


def test_reflecting_twice_changes_nothing():
    plane = SymmetryPlane(np.array([0.6, 0.0, 0.8]), 0.3, 1.0)
    points = np.random.default_rng(0).normal(size=(10, 3))
    np.testing.assert_allclose(plane.reflect(plane.reflect(points)), points, atol=1e-12)
    on_plane = plane.normal * plane.offset
    np.testing.assert_allclose(plane.reflect(on_plane[None]), on_plane[None], atol=1e-12)


def views_of_the_corner() -> list[ObjectView]:
    """The box from one corner, in several poses; 200 pixels of it are enough for masks."""
    mesh = trimesh.creation.box(SIZE).subdivide().subdivide()
    guide = Guide(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))
    views = []
    for index, (yaw, pitch) in enumerate(((-45, 30), (-38, 25), (-52, 25), (-45, 38), (-35, 35), (-55, 35))):
        T_cam_obj = pose(yaw, pitch)
        image, frame = np.zeros((160, 160, 3), np.uint8), np.ones((160, 160), bool)
        everywhere = ObjectView.of_frame(index, image, frame, CAMERA, T_cam_obj)
        mask = np.isfinite(guide.visible_to(everywhere)[0])
        seen = shape_view(ObjectView.of_frame(index, image, mask, CAMERA, T_cam_obj))
        assert seen is not None
        views.append(seen)
    return views


@pytest.fixture(scope="module")
def completed() -> tuple[Grid, NDArray[np.float32], NDArray[np.float32], list[SymmetryPlane]]:
    """The convex hull of three faces, in a volume; the same completed; and the planes."""
    views = views_of_the_corner()
    towards = views[0].T_cam_obj[:3, :3].T @ [0, 0, -1.0]
    corners = trimesh.creation.box(SIZE).vertices
    hidden = int(np.argmin(corners @ (np.sign(towards) * SIZE)))
    part = trimesh.convex.convex_hull(np.delete(corners, hidden, 0))
    grid = Grid.around(corners, 40, 0.15)
    inside = mesh_distance(grid, part.vertices, part.faces, 0.3)
    more, planes = complete_by_symmetry(grid, inside, np.full_like(inside, 0.3), views)
    return grid, inside, more, planes


def test_the_hidden_corner_of_a_box_is_completed(completed):
    grid, inside, more, planes = completed
    true = float(np.prod(SIZE))
    before, after = ((volume > 0).sum() * grid.spacing**3 / true for volume in (inside, more))
    assert planes
    assert before == pytest.approx(5 / 6, abs=0.04)
    assert after == pytest.approx(1.0, abs=0.06)


def test_what_was_there_stays(completed):
    _, inside, more, _ = completed
    assert (more >= inside).all()


def test_nothing_is_added_outside_the_hull():
    views = views_of_the_corner()
    corners = trimesh.creation.box(SIZE).vertices
    grid = Grid.around(corners, 30, 0.15)
    part = trimesh.convex.convex_hull(corners[list(next(combinations(range(8), 7)))])
    inside = mesh_distance(grid, part.vertices, part.faces, 0.3)
    more, _ = complete_by_symmetry(grid, inside, np.minimum(inside, 0.3), views)
    np.testing.assert_array_equal(more, inside)
