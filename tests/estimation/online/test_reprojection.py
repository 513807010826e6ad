"""Projection and its derivatives are those of a pinhole camera and of a step in the camera's axes."""

from __future__ import annotations

import numpy as np
from tracked_solids import intrinsics
from twins.reprojection import pixel_by_point, pixel_by_pose

from tracking3d.points.bundle_adjustment.reprojection import (
    apply_pose_steps,
    finite_rows,
    project_camera_points,
    transform_to_camera,
)

K = intrinsics(45.0)
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform(-1, 1, size=(5, 3))
R = apply_pose_steps(np.eye(3)[None], np.zeros((1, 3)), RANDOM.normal(size=(1, 6)))[0]
T = np.array([[0.3, -0.2, 6.0]])


def test_a_point_on_the_axis_is_seen_at_the_principal_point():
    assert np.array_equal(project_camera_points(np.array([0.0, 0.0, 3.0]), K), K[:2, 2])


def test_a_point_one_to_the_right_at_depth_two_is_half_a_focal_length_to_the_right():
    assert np.allclose(project_camera_points(np.array([1.0, 0.0, 2.0]), K) - K[:2, 2], [K[0, 0] / 2, 0])


def test_a_point_behind_the_camera_has_no_image_and_no_derivative():
    behind = np.array([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0]])
    assert np.isnan(project_camera_points(behind, K)).all()
    assert not pixel_by_point(behind, K).any()


def test_the_derivative_by_the_point_is_the_finite_difference():
    x = transform_to_camera(R, T, POINTS)[0]
    steps = 1e-6 * np.eye(3)
    finite = np.stack(
        [(project_camera_points(x + d, K) - project_camera_points(x - d, K)) / 2e-6 for d in steps], -1
    )
    assert np.allclose(pixel_by_point(x, K), finite, atol=1e-5)


def test_the_derivative_by_the_pose_is_the_finite_difference_of_moved():
    def seen(step):
        return project_camera_points(transform_to_camera(*apply_pose_steps(R, T, step[None]), POINTS)[0], K)

    x = transform_to_camera(R, T, POINTS)[0]
    finite = np.stack([(seen(d) - seen(-d)) / 2e-6 for d in 1e-6 * np.eye(6)], -1)
    assert np.allclose(pixel_by_pose(pixel_by_point(x, K), x - T[0]), finite, atol=1e-4)


def test_a_rotation_turns_about_the_objects_origin_and_not_about_the_camera():
    turned = apply_pose_steps(np.eye(3)[None], T, np.array([[0, 0, 0, 0.1, 0.2, 0.3]]))
    assert np.array_equal(turned[1], T)
    assert np.allclose(transform_to_camera(*turned, np.zeros((1, 3)))[0], T)


def test_rows_are_finite_when_all_their_numbers_are():
    assert finite_rows(np.array([[0.0, 1.0], [np.nan, 1.0], [0.0, np.inf]])).tolist() == [True, False, False]
