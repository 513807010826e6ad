"""The one camera of a video, and windows of it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tracking3d.geometry.camera import Camera, Window

POINTS = np.array([[0.3, -0.2, 2.0], [-1.0, 0.5, 4.0], [0.0, 0.0, 1.0], [2.0, 2.0, 3.0]])


def project(K: np.ndarray, points: np.ndarray) -> np.ndarray:
    pixels = points @ K.T
    return pixels[:, :2] / pixels[:, 2:]


def test_the_field_of_view_is_vertical_and_measured_between_the_outer_edges():
    camera = Camera.from_fov(640, 480, 50.0)
    top = project(camera.K, np.array([[0.0, -math.tan(math.radians(25)), 1.0]]))[0]
    assert top == pytest.approx([319.5, -0.5])
    assert camera.fx == camera.fy
    assert camera.origin == "default field of view"


def test_without_a_field_of_view_it_is_the_papers_45_degrees():
    assert Camera.from_fov(100, 480).fy == pytest.approx(240 / math.tan(math.radians(22.5)))


def test_the_principal_point_is_the_middle_of_the_pixel_grid():
    camera = Camera.from_fov(5, 3)
    assert project(camera.K, np.array([[0.0, 0.0, 7.0]]))[0] == pytest.approx([2.0, 1.0])


def test_the_whole_square_frame_as_a_window_is_the_camera_itself():
    camera = Camera(300.0, 280.0, 31.0, 33.0, 64, 64)
    np.testing.assert_allclose(Window(0, 0, 64, 64).K(camera), camera.K)


@pytest.mark.parametrize("window", [Window(10, 20, 64, 64), Window(-7, 3, 50, 128), Window(5, -9, 90, 31)])
def test_window_pixels_are_frame_pixels_shifted_and_scaled_about_their_edges(window):
    camera = Camera(310.0, 290.0, 78.2, 61.7, 160, 120)
    full, inside = project(camera.K, POINTS), project(window.K(camera), POINTS)
    edge = np.array([window.left, window.top]) - 0.5
    np.testing.assert_allclose((full - edge) / window.side, (inside + 0.5) / window.size)
    assert window.scale == window.size / window.side


@pytest.mark.parametrize("window", [Window(10, 20, 64, 64), Window(-7, 3, 50, 128)])
def test_the_windows_corners_are_the_regions_corners(window):
    camera = Camera(310.0, 290.0, 78.2, 61.7, 160, 120)
    back = camera.K @ np.linalg.inv(window.K(camera))
    corners = np.array([[-0.5, -0.5, 1.0], [window.size - 0.5, window.size - 0.5, 1.0]])
    first, last = project(back, corners)
    assert first == pytest.approx([window.left - 0.5, window.top - 0.5])
    assert last == pytest.approx([window.left + window.side - 0.5, window.top + window.side - 0.5])


@pytest.mark.parametrize("box", [(30.0, 40.0, 20.0, 10.0), (0.0, 0.0, 5.5, 90.25), (-8.0, 100.0, 33.0, 33.0)])
@pytest.mark.parametrize("margin", [0.0, 0.25, 1.0])
def test_a_window_around_a_box_holds_it_with_its_margin_in_the_middle(box, margin):
    x, y, width, height = box
    window = Window.around(box, margin, 64)
    assert window.size == 64
    assert window.side == pytest.approx(max(width, height) * (1 + 2 * margin), abs=0.5)
    # To a pixel: windows begin at whole pixels.
    assert window.left + window.side / 2 == pytest.approx(x + width / 2, abs=1.0)
    assert window.top + window.side / 2 == pytest.approx(y + height / 2, abs=1.0)


def test_a_window_around_a_speck_still_has_an_extent():
    assert Window.around((50.0, 50.0, 0.0, 0.0), 0.3, 32).side >= 4
