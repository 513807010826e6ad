"""Visible surface discrepancy by hand, pixel by pixel, and of models that are drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tracking3d_bench.evaluation.vsd import TOLERANCES, depth_to_distance, model_depth, vsd

K = np.array([[50.0, 0, 15.5], [0, 50, 11.5], [0, 0, 1]])
SIZE = (32, 24)
FAR = np.array([[1e6, 0, 0], [0, 1e6, 0], [0, 0, 1.0]])
"""A camera so narrow that distance is depth."""


def depths(**values):
    """``(4, 5)`` images of zeros with single pixels set, as ``depths(a={(0, 0): 3.0})``."""
    images = []
    for pixels in values.values():
        image = np.zeros((4, 5))
        for place, depth in pixels.items():
            image[place] = depth
        images.append(image)
    return images


def slow_vsd(depth_est, depth_true, depth_test, delta, diameter, tolerance):
    """Every pixel by the definition, with the camera K."""
    differing = either = 0
    height, width = depth_test.shape
    for y in range(height):
        for x in range(width):
            ray = math.sqrt(((x - K[0, 2]) / K[0, 0]) ** 2 + ((y - K[1, 2]) / K[1, 1]) ** 2 + 1)
            estimated, true, test = (image[y, x] * ray for image in (depth_est, depth_true, depth_test))
            seen_true = true > 0 and (test == 0 or true - test <= delta)
            seen_est = estimated > 0 and (test == 0 or estimated - test <= delta or seen_true)
            either += seen_true or seen_est
            agrees = seen_true and seen_est and abs(true - estimated) / diameter < tolerance
            differing += (seen_true or seen_est) and not agrees
    return differing / either if either else 1.0


@pytest.mark.parametrize("seed", range(5))
def test_errors_are_those_found_pixel_by_pixel(seed):
    random = np.random.default_rng(seed)
    estimated, true, test = 100 + 20 * random.normal(size=(3, 24, 32))
    for image in (estimated, true, test):
        image[random.random(image.shape) < 0.3] = 0
    errors = vsd(estimated, true, test, K, delta=15, diameter=60)
    expected = [slow_vsd(estimated, true, test, 15, 60, tolerance) for tolerance in TOLERANCES]
    np.testing.assert_allclose(errors, expected)
    assert (np.diff(errors) <= 0).all()


def test_the_same_surface_has_no_error():
    (image,) = depths(a={(1, 1): 100.0, (1, 2): 101.0})
    assert vsd(image, image, image, FAR, 15, 50) == pytest.approx(np.zeros(10))


def test_surfaces_side_by_side_differ_everywhere():
    estimated, true, test = depths(a={(0, 0): 100.0}, b={(0, 1): 100.0}, c={})
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15, 50), np.ones(10))


def test_a_misalignment_counts_from_its_tolerance_on():
    # 10 of 50: more than the tolerances 0.05 to 0.15, and not less than 0.2.
    estimated, true, test = depths(a={(0, 0): 110.0}, b={(0, 0): 100.0}, c={(0, 0): 100.0})
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15, 50), [1] * 4 + [0] * 6)


def test_pixels_that_are_hidden_at_both_poses_do_not_count():
    estimated, true, test = depths(
        a={(0, 0): 100.0, (1, 1): 100.0}, b={(0, 0): 100.0, (1, 1): 140.0}, c={(0, 0): 100.0, (1, 1): 80.0}
    )
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15, 50), np.zeros(10))


def test_delta_is_how_far_behind_the_measured_surface_a_pixel_is_seen():
    estimated, true, test = depths(a={}, b={(0, 0): 100.0}, c={(0, 0): 85.0})
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15.1, 50), np.ones(10))
    estimated, true, test = depths(a={(2, 2): 100.0}, b={(0, 0): 100.0, (2, 2): 100.0}, c={(0, 0): 84.0})
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15.1, 50), np.zeros(10))


def test_without_measured_depth_the_model_is_seen():
    estimated, true, test = depths(a={}, b={(0, 0): 100.0}, c={})
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15, 50), np.ones(10))


def test_what_is_seen_at_the_true_pose_is_not_hidden_at_the_estimated_one():
    # The estimate is 30 behind the measured surface, which is the object's own at the true pose.
    estimated, true, test = depths(a={(0, 0): 130.0}, b={(0, 0): 100.0}, c={(0, 0): 100.0})
    np.testing.assert_array_equal(vsd(estimated, true, test, FAR, 15, 100), [1] * 6 + [0] * 4)


def test_a_model_that_is_seen_at_neither_pose_is_wrong():
    np.testing.assert_array_equal(vsd(*depths(a={}, b={}, c={}), FAR, 15, 50), np.ones(10))


def test_distance_is_along_the_ray():
    distance = depth_to_distance(np.full((24, 32), 2.0), K)
    assert distance[0, 0] == pytest.approx(2 * math.sqrt((15.5 / 50) ** 2 + (11.5 / 50) ** 2 + 1))
    assert depth_to_distance(np.full((1, 1), 7.0), np.eye(3))[0, 0] == 7


def test_a_drawn_wall_has_its_depth_at_every_pixel():
    wall = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], dtype=float)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0.3, 0]).as_matrix()
    T[:3, 3] = [0, 0, 5]
    depth = model_depth(wall, [[0, 1, 2], [0, 2, 3]], T, K, SIZE)
    x, y = np.meshgrid((np.arange(32) - 15.5) / 50, (np.arange(24) - 11.5) / 50)
    normal = T[:3, 2]
    expected = normal @ T[:3, 3] / (normal[0] * x + normal[1] * y + normal[2])
    np.testing.assert_allclose(depth, expected, rtol=1e-5)


def test_faces_are_drawn_from_both_sides():
    triangle = np.array([[-9, -9, 5], [9, -9, 5], [0, 9, 5]], dtype=float)
    one, other = (model_depth(triangle, [face], np.eye(4), K, SIZE) for face in ([0, 1, 2], [0, 2, 1]))
    assert np.count_nonzero(one) > 100
    np.testing.assert_allclose(one, other, rtol=1e-6)


def test_the_nearest_surface_hides_the_others_and_nothing_is_zero():
    ball = trimesh.creation.icosphere(4)
    T = np.eye(4)
    T[2, 3] = 10
    depth = model_depth(ball.vertices, ball.faces, T, K, (31, 23))
    # One unit at depth 10 is five pixels; the principal point is half a pixel from the centre of (15, 11).
    assert depth[11, 15] == pytest.approx(9, abs=0.02)
    assert depth[0, 0] == 0
    assert 60 < np.count_nonzero(depth) < 95


def test_a_model_behind_the_camera_is_not_drawn():
    ball = trimesh.creation.icosphere(1)
    T = np.eye(4)
    T[2, 3] = -10
    assert not model_depth(ball.vertices, ball.faces, T, K, SIZE).any()


def test_a_model_around_the_camera_is_seen_from_within():
    ball = trimesh.creation.icosphere(3)
    assert model_depth(ball.vertices, ball.faces, np.eye(4), K, SIZE) == pytest.approx(0.95, abs=0.07)


def test_a_drawn_model_at_a_growing_distance_has_a_growing_error():
    ball = trimesh.creation.icosphere(3)
    images = []
    for z in (10.0, 10.2, 10.6, 30.0):
        T = np.eye(4)
        T[2, 3] = z
        images.append(model_depth(ball.vertices, ball.faces, T, K, SIZE))
    errors = [vsd(image, images[0], images[0], K, 0.1, 2.0).mean() for image in images]
    assert errors[0] == 0
    assert (np.diff(errors) > 0.1).all()


def test_what_does_not_fit_is_refused():
    image = np.ones((4, 5))
    with pytest.raises(ValueError, match=r"depth_est needs shape \(4, 5\), got \(5, 4\)"):
        vsd(image.T, image, image, K, 15, 50)
    with pytest.raises(ValueError, match="not finite"):
        vsd(image, image, image * np.nan, K, 15, 50)
    with pytest.raises(ValueError, match=r"K needs shape \(3, 3\), got \(4, 4\)"):
        vsd(image, image, image, np.eye(4), 15, 50)
    with pytest.raises(ValueError, match="diameter needs to be positive"):
        vsd(image, image, image, K, 15, 0.0)
    with pytest.raises(ValueError, match=r"faces needs shape \(any, 3\), got \(1, 4\)"):
        model_depth(np.ones((4, 3)), [[0, 1, 2, 3]], np.eye(4), K, SIZE)
