"""One view as another one would see it: the kernel against its twin of OpenCV, and both against a known surface."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from twins import warping

from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.points.carrying import _warped
from tracking3d.points.view import open_view

MESH = sphere(12)
CAMERA = Camera(900.0, 900.0, 319.5, 239.5, 640, 480)


def view(turn: float, depth: float = 5.0):
    """A sphere whose grey is where it is seen in the image, so that what is warped says from where it came."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", turn, degrees=True).as_matrix()
    T[:3, 3] = 0.2, -0.1, depth
    x = np.linspace(0, 255, 640)[None].repeat(480, 0)
    image = np.dstack([x] * 3).round().astype(np.uint8)
    mask = np.zeros((480, 640), np.uint8)
    cv2.circle(mask, (356, 221), 150, 1, -1)
    return open_view(image, mask > 0, CAMERA, T, MESH.vertices, MESH.faces)


def test_a_point_of_the_surface_has_the_grey_of_where_the_other_view_shows_it():
    start, end = view(0.0), view(20.0)
    warped, known = _warped(start, end, 0.02)
    points = np.array([[0.0, 0.0, -1.0], [0.3, 0.2, -0.933], [-0.4, 0.1, -0.911]])
    here, there = end.project(points)[0].round().astype(int), start.project(points)[0]
    assert (known[here[:, 1], here[:, 0]] > 0.99).all()
    expected = start.to_frame(there)[:, 0] / 639 * 255
    assert np.abs(warped[here[:, 1], here[:, 0]] - expected).max() < 1.0  # half a pixel, and whole greys


def test_what_the_other_view_does_not_show_is_not_known():
    warped, known = _warped(view(0.0), view(150.0), 0.02)
    front = known[60:-60, 60:-60]
    assert (front == 0).mean() > 0.5
    assert np.isfinite(warped).all()


@pytest.mark.parametrize(("turn", "depth"), [(8.0, 5.0), (-30.0, 4.0), (0.0, 7.0)])
def test_the_kernel_agrees_with_its_twin(turn, depth):
    given = view(0.0), view(turn, depth), 0.02
    (mine, known), (expected, seen) = _warped(*given), warping.warped(*given)
    # OpenCV takes positions to a thirty-second of a pixel, which decides some pixels at the rim of what is seen.
    same = np.abs(known - seen) < 0.05
    assert same.mean() > 0.99
    assert np.abs(mine - expected)[same & (seen > 0.9)].max() < 1.0
