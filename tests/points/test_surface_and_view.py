from __future__ import annotations

import numpy as np
import pytest
from twins import surface_under_pixels

from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.points.landmark_adjustment import move_surface
from tracking3d.points.ray_intersection import surface_under
from tracking3d.points.view import open_view
from tracking3d.scene.surface import sample

MESH = sphere(8)
CAMERA = Camera(900.0, 900.0, 319.5, 239.5, 640, 480)


def pose(depth: float = 5.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = 0.2, -0.1, depth
    return T


def view(depth: float = 5.0):
    image = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    return open_view(image, np.zeros((480, 640), bool), CAMERA, pose(depth), MESH.vertices, MESH.faces)


def test_a_window_is_a_part_of_the_frame_and_its_pixels_go_there_and_back():
    near = view(2.5)  # larger than a window may be
    assert max(near.image.shape) == 320
    xy = np.random.default_rng(1).uniform(0, 480, (20, 2))
    assert np.allclose(near.to_frame(near.to_window(xy)), xy)
    points = MESH.vertices @ np.diag([1.0, 1.0, 1.0])
    seen = points + pose(2.5)[:3, 3]
    frame = (seen @ CAMERA.K.T)[:, :2] / seen[:, 2:]
    assert np.allclose(near.to_frame(near.project(points)[0]), frame)


def test_the_surface_under_a_pixel_projects_to_it():
    one = view()
    xy = one.to_window(np.array([[355.0, 221.0], [330.3, 250.8], [390.1, 200.2]]))
    points = one.surface(xy)
    assert np.allclose(one.project(points)[0], xy, atol=1e-6)
    face, weight = surface_under(*one.project(MESH.vertices), MESH.faces, xy)
    exact = np.einsum("nk,nkd->nd", weight, MESH.vertices[MESH.faces[face]])
    assert np.abs(points - exact).max() < 0.01
    assert one.sees(points, 0.02)[1].all()
    assert not one.sees(-points, 0.02)[1].any()


def test_as_many_pixels_are_looked_up_as_are_asked_for():
    one = view()
    few = one.to_window(np.array([[355.0, 221.0], [330.3, 250.8], [np.nan, 0.0]]))
    many = np.tile(few, (20_000, 1))
    np.testing.assert_array_equal(sample(one.inverse_depth, many)[-3:], sample(one.inverse_depth, few))
    assert sample(one.inverse_depth, many).shape == (60_000,)


def test_slant_is_one_in_front_and_falls_to_the_rim():
    one = view()
    middle, rim = one.project(np.array([[0.0, 0.0, -1.0], [0.9, 0.0, -0.436]]))[0]
    assert one.slant(np.stack([middle]))[0] > 0.95
    assert one.slant(np.stack([rim]))[0] < 0.5
    assert one.slant(np.array([[1.0, 1.0]]))[0] == 0


def test_there_is_no_view_without_a_pose_or_of_what_lies_outside_the_frame():
    image, mask = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), bool)
    nowhere = np.full((4, 4), np.nan)
    outside = pose()
    outside[0, 3] = 50
    behind = pose(-5)
    for T in (nowhere, outside, behind):
        assert open_view(image, mask, CAMERA, T, MESH.vertices, MESH.faces) is None


def test_a_surface_moves_smoothly_under_its_landmarks():
    vertices, faces = MESH.vertices.astype(float), MESH.faces
    face = np.arange(0, len(faces), 3)
    weight = np.full((len(face), 3), 1 / 3)
    points = vertices[faces[face]].mean(1)
    landmarks = points * 1.1
    landmarks[5] += 3.0  # a wrong one
    moved = move_surface(vertices, faces, face, weight, landmarks)
    assert np.abs(np.linalg.norm(moved, axis=1) - 1.1).max() < 0.03
    assert move_surface(vertices, faces, face[:0], weight[:0], landmarks[:0]) is vertices


@pytest.mark.parametrize("seed", range(6))
def test_the_surface_under_pixels_is_that_of_all_faces_to_the_last_digit(seed):
    """Also on edges and corners, behind the camera, and where there is no pixel at all."""
    random = np.random.default_rng(seed)
    vertices = MESH.vertices * random.uniform(0.3, 1.5, 3) + [0, 0, random.uniform(0.5, 6)]
    screen = vertices[:, :2] / vertices[:, 2:] * 300 + [160, 120]
    corners = screen[random.integers(0, len(screen), 60)]
    edges = (screen[MESH.faces[:40, 0]] + screen[MESH.faces[:40, 1]]) / 2
    xy = np.vstack([random.uniform(-50, 370, (300, 2)), corners, corners.round(), edges])
    for pixels in (xy, xy[:0]):
        found = surface_under(screen, vertices[:, 2], MESH.faces, pixels)
        expected = surface_under_pixels.surface_under(screen, vertices[:, 2], MESH.faces, pixels)
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])
