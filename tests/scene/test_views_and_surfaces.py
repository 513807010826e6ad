"""A window shows the same frame and the same object as the whole, and a surface is drawn where rays meet it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from tracking3d.geometry.camera import Camera, Window
from tracking3d.scene.surface import draw, sample
from tracking3d.scene.view import FrameCrop, ObjectView, crop_window

CAMERA = Camera(210.0, 200.0, 79.5, 59.5, 160, 120)
BOX = trimesh.creation.box((1.2, 0.8, 0.6))
SURFACE = np.asarray(BOX.vertices, np.float64), np.asarray(BOX.faces, np.int64)
SQUARE, BEYOND = Window(40, 20, 80, 48), Window(-16, -30, 150, 150)
RECTANGLE = Window(40, 20, 80, 40, (60, 45))


def pose(x: float = 0.2, z: float = 4.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.3, 0.5, 0.1]))[0]
    T[:3, 3] = x, -0.1, z
    return T


def frame(**known) -> ObjectView:
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    mask = np.hypot(*(np.mgrid[:120, :160] - np.array([55, 85])[:, None, None])) < 30
    return ObjectView.of_frame(7, image, mask, CAMERA, pose(), **known)


@pytest.mark.parametrize("window", [SQUARE, BEYOND, RECTANGLE])
def test_pixels_and_points_are_at_the_same_place_in_the_frame_and_in_a_window(window):
    whole, view = frame(), frame().at(window)
    assert view.index == 7 and view.image.shape == (*window.shape, 3) and view.mask.shape == window.shape
    xy, depth = whole.project(SURFACE[0])
    here, same = view.project(SURFACE[0])
    np.testing.assert_allclose(view.to_frame(here), xy, atol=1e-9)
    np.testing.assert_allclose(view.to_window(xy), here, atol=1e-9)
    np.testing.assert_array_equal(depth, same)
    np.testing.assert_allclose(view.back_project(here, 1 / depth), SURFACE[0], atol=1e-9)
    homogeneous = np.column_stack([here, np.ones(len(here))]) @ window.to_frame.T
    np.testing.assert_allclose(homogeneous[:, :2], xy, atol=1e-9)


def test_a_window_at_the_frames_own_size_shows_its_pixels_and_nothing_of_the_object_beyond_it():
    whole = frame(occluder=np.ones((120, 160), bool))
    view = whole.at(BEYOND)
    rows, columns = slice(30, 150), slice(16, 150)
    np.testing.assert_array_equal(view.image[rows, columns], whole.image[:, : 150 - 16])
    np.testing.assert_array_equal(view.mask[rows, columns], whole.mask[:, : 150 - 16])
    inside = np.zeros((150, 150), bool)
    inside[rows, columns] = True
    np.testing.assert_array_equal(view.in_frame, inside)
    np.testing.assert_array_equal(view.occluder, inside)
    assert view.frame_edges.tolist() == [15.5, 175.5, 29.5, 149.5]
    assert view.initial.size == 0


def test_a_rectangle_is_cut_out_as_opencv_resizes_it():
    image = frame().image
    expected = cv2.resize(image[20:80, 40:120], (40, 45), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(FrameCrop.of(image, RECTANGLE).image, expected)
    np.testing.assert_array_equal(crop_window(image, Window(40, 20, 80, 80, (60, 60))), image[20:80, 40:120])


def test_the_distance_from_an_outline_is_that_of_the_nearest_pixel_on_its_other_side():
    view = frame().at(Window(50, 20, 70, 20))
    rows, columns = np.mgrid[:20, :20]
    for row, column in ((3, 4), (10, 10), (19, 0), (8, 14)):
        other = view.mask != view.mask[row, column]
        nearest = np.hypot(rows - row, columns - column)[other].min() - 0.5
        sign = 1 if view.mask[row, column] else -1
        assert view.signed_distance[row, column] == pytest.approx(sign * nearest)
    assert view.interior[~view.mask].max() == 0 and view.interior.max() == 1


def test_another_pose_has_the_same_planes_and_another_mask_has_its_own():
    view = frame().at(SQUARE)
    distance = view.signed_distance
    assert np.array_equal(replace(view, T_cam_obj=pose(0.0)).signed_distance, distance)
    assert not np.array_equal(replace(view, mask=~view.mask).signed_distance, distance)


@pytest.mark.parametrize("window", [SQUARE, RECTANGLE])
def test_a_surface_is_as_deep_as_rays_say_and_goes_on_at_the_depth_of_the_nearest_pixel(window):
    drawn = draw(frame().at(window), *SURFACE)
    height, width = window.shape
    v, u = (one.ravel() for one in np.mgrid[:height, :width])
    T, rays = drawn.T_cam_obj, np.column_stack([u, v, np.ones(u.size)]) @ np.linalg.inv(drawn.K).T
    origin = np.tile(-T[:3, :3].T @ T[:3, 3], (u.size, 1))
    at, ray, _ = BOX.ray.intersects_location(origin, rays @ T[:3, :3], multiple_hits=False)
    depth = np.full(u.size, np.inf)
    depth[ray] = at @ T[2, :3] + T[2, 3]
    there = np.isfinite(depth).reshape(height, width)
    assert np.count_nonzero(there ^ drawn.silhouette) <= 2  # rays on an edge
    both = there & drawn.silhouette
    np.testing.assert_allclose(drawn.inverse_depth[both], 1 / depth.reshape(height, width)[both], rtol=1e-4)
    row, column = np.nonzero(drawn.silhouette)
    for y, x in ((0, 0), (height - 1, width - 1), (height // 2, 0)):
        away = np.hypot(row - y, column - x)
        near = np.flatnonzero(away < away.min() + 1)
        assert drawn.inverse_depth[y, x] in drawn.inverse_depth[row[near], column[near]]
        assert drawn.beyond[y, x] == pytest.approx(away.min(), rel=0.05)
    short = draw(drawn, *SURFACE, reach=5)
    np.testing.assert_array_equal(short.inverse_depth > 0, drawn.beyond < 5)
    np.testing.assert_array_equal(short.beyond, drawn.beyond)


def test_a_silhouette_ends_with_the_frame_and_the_surface_does_not():
    drawn = draw(replace(frame(), T_cam_obj=pose(x=1.6)).at(BEYOND), *SURFACE)
    cut = (drawn.beyond == 0) & ~drawn.in_frame
    drawn = draw(replace(frame(), T_cam_obj=pose(x=-1.5)).at(BEYOND), *SURFACE)
    cut = cut.sum() + ((drawn.beyond == 0) & ~drawn.in_frame).sum()
    assert cut > 0 and drawn.silhouette.any()
    assert not (drawn.silhouette & ~drawn.in_frame).any()


@pytest.mark.parametrize("T", [np.full((4, 4), np.nan), pose(z=-4.0), pose(x=40.0)])
def test_nothing_is_drawn_without_a_pose_behind_the_camera_or_beside_the_window(T):
    drawn = draw(replace(frame().at(SQUARE), T_cam_obj=T), *SURFACE)
    assert not drawn.silhouette.any() and not drawn.inverse_depth.any()
    assert drawn.beyond.min() > np.hypot(48, 48)
    assert np.isnan(drawn.surface(np.array([[3.0, 4.0]]))).all()


def test_values_between_pixels_are_looked_up_however_many():
    plane = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert sample(plane, np.array([[1.5, 1.0], [np.nan, 0.0], [9.0, 9.0]])).tolist() == [5.5, 0.0, 11.0]
    assert sample(plane, np.zeros((40_000, 2))).shape == (40_000,)
