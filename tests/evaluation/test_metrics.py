"""Measures on cases computed by hand, and properties they must have."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.geometry.alignment import rotation_alignment
from tracking3d_bench.evaluation.metrics import (
    aligned_rotation_errors,
    anchored_rotation_errors,
    consecutive_rotation_errors,
    mask_iou,
    share_under,
)

Y = np.array([0.0, 1.0, 0.0])


def turns(angles, axis=Y):
    """``(N, 3, 3)`` rotations about one axis by degrees."""
    return Rotation.from_rotvec(np.radians(angles)[:, None] * axis).as_matrix()


def random_rotations(count, seed=0):
    return Rotation.random(count, random_state=np.random.default_rng(seed)).as_matrix()


def square(left, size=10, width=40):
    mask = np.zeros((30, width), bool)
    mask[5 : 5 + size, left : left + size] = True
    return mask


def test_equal_masks_overlap_fully():
    assert mask_iou(square(3), square(3)) == 1.0


def test_separate_masks_do_not_overlap():
    assert mask_iou(square(0), square(20)) == 0.0


@pytest.mark.parametrize("shift", [1, 3, 7])
def test_a_shifted_square_has_the_known_iou(shift):
    # 10 - s columns are shared of 10 + s.
    assert mask_iou(square(0), square(shift)) == pytest.approx((10 - shift) / (10 + shift), abs=1e-12)


def test_two_empty_masks_agree_and_one_empty_mask_does_not():
    empty = np.zeros((30, 40), bool)
    assert mask_iou(empty, empty) == 1.0
    assert mask_iou(empty, square(0)) == 0.0


def test_a_perfect_estimate_has_no_error_by_any_measure():
    R = random_rotations(20)
    for errors in (aligned_rotation_errors, anchored_rotation_errors, consecutive_rotation_errors):
        assert errors(R, R) == pytest.approx(0, abs=1e-9)


def test_another_object_frame_is_no_error():
    R, A = turns(np.arange(30) * 3.0), random_rotations(1, seed=3)[0]
    for errors in (aligned_rotation_errors, anchored_rotation_errors, consecutive_rotation_errors):
        assert errors(R, R @ A) == pytest.approx(0, abs=1e-9)
    assert rotation_alignment(R, R @ A) == pytest.approx(A, abs=1e-12)


def test_another_camera_frame_is_an_error():
    R = random_rotations(20)
    assert np.median(aligned_rotation_errors(turns(np.array([40.0]))[0] @ R, R)) > 20


def test_one_wrong_frame_shows_with_exactly_its_error_and_no_other_does():
    R = random_rotations(15)
    estimate = R.copy()
    estimate[6] = turns(np.array([30.0]))[0] @ R[6]
    errors = aligned_rotation_errors(estimate, R)
    assert errors[6] == pytest.approx(30, abs=1e-9)
    assert np.delete(errors, 6) == pytest.approx(0, abs=1e-9)


def test_a_wrong_first_frame_spoils_every_anchored_error_and_one_consecutive_error():
    R = turns(np.arange(10) * 5.0)
    estimate = R.copy()
    estimate[0] = turns(np.array([20.0]))[0] @ R[0]
    assert anchored_rotation_errors(estimate, R) == pytest.approx([0] + [20] * 9, abs=1e-9)
    assert consecutive_rotation_errors(estimate, R) == pytest.approx([20] + [0] * 8, abs=1e-9)


def test_under_rotation_is_aligned_at_the_middle_and_anchored_at_the_start():
    frames = np.arange(11.0)
    estimate, truth = turns(frames * 4), turns(frames * 5)
    assert aligned_rotation_errors(estimate, truth) == pytest.approx(np.abs(frames - 5), abs=1e-6)
    assert anchored_rotation_errors(estimate, truth) == pytest.approx(frames, abs=1e-9)
    assert consecutive_rotation_errors(estimate, truth) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_thirty_percent_outliers_do_not_move_the_alignment(seed):
    rng = np.random.default_rng(seed)
    truth = random_rotations(200, seed)
    noise = Rotation.from_rotvec(np.radians(rng.normal(0, 1, (200, 3)))).as_matrix()
    A = random_rotations(1, seed + 50)[0]
    estimate = truth @ A.T @ noise
    outliers = rng.permutation(200)[:60]
    estimate[outliers] = random_rotations(60, seed + 100)
    found = rotation_alignment(estimate, truth)
    assert np.degrees(Rotation.from_matrix(found @ A.T).magnitude()) < 0.5
    assert np.median(np.delete(aligned_rotation_errors(estimate, truth), outliers)) < 2.5


@pytest.mark.parametrize("seed", range(3))
def test_no_rotation_near_the_alignment_has_a_smaller_sum_of_errors(seed):
    truth = random_rotations(40, seed)
    noise = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.3, (40, 3))).as_matrix()
    estimate = truth @ noise
    least = aligned_rotation_errors(estimate, truth).sum()
    A = Rotation.from_matrix(rotation_alignment(estimate, truth))
    for step in np.random.default_rng(seed).normal(0, 1, (200, 3)) * np.logspace(-5, 0, 200)[:, None]:
        other = Rotation.from_matrix(estimate) * (A * Rotation.from_rotvec(step))
        assert np.degrees((other.inv() * Rotation.from_matrix(truth)).magnitude()).sum() >= least - 1e-6


def test_the_alignment_is_found_among_two_clusters_of_answers():
    # 12 frames agree on one object frame, 8 on another, 120 degrees away: the majority is right.
    truth = random_rotations(20)
    estimate = truth.copy()
    estimate[:8] = truth[:8] @ turns(np.array([120.0]))[0]
    assert aligned_rotation_errors(estimate, truth) == pytest.approx([120] * 8 + [0] * 12, abs=1e-9)


def test_a_half_turn_is_the_largest_error():
    R = random_rotations(7)
    estimate = R.copy()
    estimate[3] = R[3] @ turns(np.array([180.0]))[0]
    assert aligned_rotation_errors(estimate, R)[3] == pytest.approx(180, abs=1e-6)


def test_a_long_clip_is_aligned_from_a_subset_of_starts():
    truth = random_rotations(3000)
    assert aligned_rotation_errors(truth @ random_rotations(1, 9)[0], truth) == pytest.approx(0, abs=1e-6)


def test_one_frame_alone_is_aligned_exactly():
    a, b = random_rotations(2)
    assert aligned_rotation_errors(a[None], b[None]) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("shape", [(0, 3, 3), (4, 3, 3), (3, 3)])
def test_rotations_of_unequal_or_no_number_are_refused(shape):
    with pytest.raises(ValueError, match="equal shapes"):
        aligned_rotation_errors(np.zeros(shape), random_rotations(0 if shape[0] == 0 else 5))


def test_the_share_under_a_limit_is_strict():
    assert share_under(np.array([0.0, 4.999, 5.0, 90.0])) == 0.5
    assert share_under(np.array([1.0, 2.0]), limit=1.5) == 0.5
