"""Points that the images followed come to lie on the surface: where that is so, and where it only looks so."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.points.follow import FEATURES, Followed
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.surface_association import meetings, merge_image_points
from tracking3d.points.view import open_view

MESH = sphere(12)
CAMERA = Camera(900.0, 900.0, 319.5, 239.5, 640, 480)
VIEWS = 10


def poses(step: float = 4.0) -> list[np.ndarray]:
    result = []
    for index in range(VIEWS):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("y", step * index, degrees=True).as_matrix()
        T[:3, 3] = 0.2, -0.1, 5.0
        result.append(T)
    return result


def scene(Ts: list[np.ndarray]) -> LandmarkScene:
    image, mask = np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), bool)
    views = [open_view(image, mask, CAMERA, T, MESH.vertices, MESH.faces) for T in Ts]
    return LandmarkScene(list(views), np.asarray(MESH.vertices, float), np.asarray(MESH.faces))


def seen(points: np.ndarray, Ts: list[np.ndarray]) -> np.ndarray:
    """``(T, N, 2)``."""
    there = np.stack([points @ T[:3, :3].T + T[:3, 3] for T in Ts])
    return there[..., :2] / there[..., 2:] * 900.0 + (319.5, 239.5)


def met(points: np.ndarray, Ts: list[np.ndarray], answered: list[np.ndarray] | None = None) -> np.ndarray:
    """In which view points that the images have at their true places are tied, by answered poses."""
    xy = seen(points, Ts)
    shape = xy.shape[:2]
    return meetings(
        scene(Ts if answered is None else answered), xy, np.full(shape, 0.3), np.ones(shape, bool)
    )


def test_points_of_the_surface_are_tied_to_it():
    points = np.array([[0.0, 0.0, -1.0], [-0.3, 0.2, -0.933]])
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert (met(points, poses()) >= 0).all()


def test_a_point_that_stands_out_of_the_surface_is_not_though_pixels_behind_it_are():
    assert met(np.array([[0.0, 0.0, -1.3]]), poses()).tolist() == [-1]


def test_from_one_side_nothing_is_told():
    assert met(np.array([[0.0, 0.0, -1.0]]), poses(step=0.2)).tolist() == [-1]


def test_a_pose_that_is_off_where_the_point_was_asked_for_does_not_hold_it_back():
    Ts = poses()
    wrong = [T.copy() for T in Ts]
    wrong[0][0, 3] += 2.5  # the surface is elsewhere
    row = met(np.array([[0.0, 0.0, -1.0]]), Ts, wrong)[0]
    assert row > 0


def test_places_that_are_hardly_known_tie_nothing():
    xy = seen(np.array([[0.0, 0.0, -1.0]]), poses())
    unsure, none = np.full((VIEWS, 1), 20.0), np.zeros((VIEWS, 1), bool)
    assert meetings(scene(poses()), xy, unsure, ~none).tolist() == [-1]
    assert meetings(scene(poses()), xy, 0 * unsure + 0.3, none).tolist() == [-1]


@pytest.fixture
def surface() -> Followed:
    """One point in three views: known by the surface in the first two."""
    positions = np.array([[[10.0, 10.0]], [[20.0, 20.0]], [[np.nan, np.nan]]])
    return Followed(
        positions,
        np.array([[True], [False], [False]]),
        np.array([[1.0], [1.0], [np.nan]]),
        np.zeros((3, 1), bool),
        np.zeros((1, 3)),
        np.full((3, 1, FEATURES), np.nan),
    )


def test_surface_and_images_are_brought_together_by_variance(surface):
    xy = np.array([[[10.0, 11.0]], [[20.0, 20.0]], [[30.0, 30.0]]])
    found = np.array([[True], [False], [True]])
    both = merge_image_points(surface, xy, np.full((3, 1), 0.5), found)
    np.testing.assert_allclose(both.positions[:, 0], [(10, 10.8), (20, 20), (30, 30)])
    np.testing.assert_allclose(both.uncertainty[:, 0], [0.5, 1.0, 0.5])
    assert both.visible[:, 0].tolist() == [True, False, True]
    assert both.measured[:, 0].tolist() == [True, False, True]


def test_where_they_contradict_the_image_counts_and_the_gap_is_told(surface):
    xy = np.array([[[10.0, 30.0]], [[20.0, 20.0]], [[30.0, 30.0]]])
    both = merge_image_points(surface, xy, np.full((3, 1), 0.5), np.array([[True], [False], [False]]))
    np.testing.assert_allclose(both.positions[0, 0], (10, 30))
    assert both.uncertainty[0, 0] == pytest.approx(10)
    assert np.isnan(both.positions[2]).all() and np.isnan(both.uncertainty[2]).all()
    nothing = dataclasses.replace(surface, positions=np.full((3, 1, 2), np.nan))
    assert np.isnan(
        merge_image_points(nothing, xy, np.full((3, 1), 0.5), np.zeros((3, 1), bool)).positions
    ).all()
