"""The similarity between an estimated and a true object frame, and translation errors after it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.geometry.alignment import ObjectAlignment, align_object_frame
from tracking3d_bench.evaluation.alignment import align_on_frame, translation_errors

A = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
KNOWN = ObjectAlignment(A, 700.0, np.array([0.3, -0.5, 0.2]))
"""Estimates in units of 0.7 m against a truth in millimetres, from another origin."""


def true_poses(frames=60, turn=1.0, move=0.05, seed=0):
    """An object about 3 units away that turns by ``turn`` radians while it walks at random."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(
        np.linspace(0, turn, frames)[:, None] * axis / np.linalg.norm(axis)
    ).as_matrix()
    path = np.array([0.1, -0.2, 3]) + np.cumsum(random.normal(size=(frames, 3)) * move, axis=0)
    T[:, :3, 3] = KNOWN.scale * path
    return T


def estimate(T_true, known=KNOWN):
    """What a perfect estimator in another object frame says."""
    T = T_true.copy()
    T[:, :3, :3] = T_true[:, :3, :3] @ known.A.T
    T[:, :3, 3] = T_true[:, :3, 3] / known.scale - T[:, :3, :3] @ known.offset
    return T


def assert_known(alignment, known=KNOWN):
    np.testing.assert_allclose(alignment.A, known.A, atol=1e-9)
    assert alignment.scale == pytest.approx(known.scale, rel=1e-9)
    np.testing.assert_allclose(alignment.offset, known.offset, atol=1e-9)


def test_both_object_frames_put_a_point_at_the_same_place_in_the_camera():
    T_true, x_true = true_poses(3), np.array([1.0, 2.0, 3.0, 1.0])
    x_est = np.linalg.solve(KNOWN.T_true_est, x_true)
    for seen, known in zip(estimate(T_true) @ x_est, T_true @ x_true, strict=True):
        np.testing.assert_allclose(KNOWN.scale * seen[:3], known[:3], rtol=1e-12)


def test_aligned_estimates_are_the_true_poses():
    T_true = true_poses()
    np.testing.assert_allclose(KNOWN.poses(estimate(T_true)), T_true, atol=1e-9)


def test_the_true_origin_lies_at_the_offset():
    np.testing.assert_allclose(
        KNOWN.T_true_est[:3, :3] @ KNOWN.offset + KNOWN.T_true_est[:3, 3], 0, atol=1e-12
    )


@pytest.mark.parametrize(
    ("turn", "move"), [(1.0, 0.05), (0.05, 0.05), (1.0, 0.0), (0.0, 0.05)], ids=lambda value: str(value)
)
def test_a_known_similarity_is_found_exactly(turn, move):
    T_true = true_poses(turn=turn, move=move)
    assert_known(align_object_frame(estimate(T_true), T_true))


def test_two_frames_that_differ_are_enough():
    T_true = true_poses(2)
    assert_known(align_object_frame(estimate(T_true), T_true))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "wrong",
    [
        lambda random: np.array([0.0, 0.0, 6.0]),
        lambda random: np.array([0.0, 0.0, 1e-3]),
        lambda random: random.normal(size=(18, 3)) * 5,
        lambda random: random.normal(size=(18, 3)) * 1e12,
    ],
    ids=["twice as far", "in the camera", "anywhere", "blown up"],
)
def test_thirty_percent_of_wrong_frames_change_nothing(wrong, seed):
    T_true, random = true_poses(seed=seed), np.random.default_rng(seed)
    T_est, bad = estimate(T_true), random.permutation(60)[:18]
    T_est[bad, :3, 3] = wrong(random)
    T_est[bad, :3, :3] = Rotation.random(18, random_state=random).as_matrix()
    alignment = align_object_frame(T_est, T_true)
    assert_known(alignment)
    errors = translation_errors(T_est, T_true, alignment)
    assert np.delete(errors, bad) == pytest.approx(0, abs=1e-9)
    assert (errors[bad] > 0.1).all()


def test_a_block_of_frames_stuck_at_the_last_good_pose_changes_nothing():
    T_true = true_poses(move=0.1)
    T_est = estimate(T_true)
    T_est[42:] = T_est[41]
    assert_known(align_object_frame(T_est, T_true))


def test_noise_moves_the_similarity_little():
    T_true, random = true_poses(), np.random.default_rng(1)
    T_est = estimate(T_true)
    noise = random.normal(size=(60, 3)) * 0.01
    T_est[:, :3, 3] += noise
    alignment = align_object_frame(T_est, T_true)
    assert alignment.scale == pytest.approx(KNOWN.scale, rel=0.02)
    errors = translation_errors(T_est, T_true, alignment, diameter=KNOWN.scale)
    size = np.linalg.norm(noise, axis=1).mean()
    assert 0.85 * size < errors.mean() < size


@pytest.mark.parametrize("diameter", [None, 60.0, 300.0])
def test_no_similarity_nearby_has_a_smaller_sum_of_errors_up_to_the_limit(diameter):
    T_true, random = true_poses(40), np.random.default_rng(2)
    T_est = estimate(T_true)
    T_est[:, :3, 3] += random.normal(size=(40, 3)) * 0.02
    T_est[::4, :3, 3] += random.normal(size=(10, 3)) * 0.3
    found = align_object_frame(T_est, T_true, diameter)
    limit = diameter / 2 if diameter else 0.1 * np.median(np.linalg.norm(T_true[:, :3, 3], axis=1))

    def cost(scale, offset):
        moved = ObjectAlignment(found.A, scale, offset)
        return np.minimum(translation_errors(T_est, T_true, moved, diameter=1.0), limit).sum()

    best = cost(found.scale, found.offset)
    for _ in range(1000):
        size = 10.0 ** random.uniform(-4, -1)
        factor = np.exp(random.normal() * size)
        assert cost(found.scale * factor, found.offset + random.normal(size=3) * size) > 0.9999 * best


def test_the_diameter_says_how_far_off_is_wrong():
    # 20 of 60 frames are off by 30: within half a large object they pull, beyond half a small one they do not.
    T_true = true_poses()
    T_est = estimate(T_true)
    T_est[::3, 0, 3] += 30 / KNOWN.scale * np.linspace(0.5, 1.5, 20)
    assert_known(align_object_frame(T_est, T_true, diameter=20.0))


def test_a_frame_that_stands_still_leaves_the_shortest_offset():
    T_true = true_poses(1)
    T_est = estimate(T_true)
    alignment = align_object_frame(T_est, T_true)
    np.testing.assert_allclose(alignment.poses(T_est), T_true, atol=1e-9)
    # The rest of scale * t_est to t_true is shortest where it is perpendicular to t_est.
    assert T_est[0, :3, 3] @ T_est[0, :3, :3] @ alignment.offset == pytest.approx(0, abs=1e-12)
    many = align_object_frame(np.repeat(T_est, 5, axis=0), np.repeat(T_true, 5, axis=0))
    assert many.scale == pytest.approx(alignment.scale, rel=1e-9)


def test_the_scale_stays_positive_where_the_estimate_goes_the_wrong_way():
    T_true = true_poses(turn=0.0)
    T_est = T_true.copy()
    T_est[:, :3, 3] = 2 * T_true[:, :3, 3].mean(0) - T_true[:, :3, 3]
    assert align_object_frame(T_est, T_true).scale > 0


@pytest.mark.parametrize("seed", range(5))
def test_an_estimate_that_says_nothing_is_not_excused_by_a_scale_of_zero(seed):
    T_true = true_poses(seed=seed)
    T_est, random = estimate(T_true), np.random.default_rng(seed)
    T_est[:, :3, 3] = np.array([0.0, 0.0, 3.0]) + random.normal(size=(60, 3))
    alignment = align_object_frame(T_est, T_true)
    assert 0.3 * KNOWN.scale < alignment.scale < 3 * KNOWN.scale
    # One unit of noise in each of three directions, at a distance of three.
    assert np.median(translation_errors(T_est, T_true, alignment)) > 0.2


def test_a_truth_in_the_camera_still_has_a_similarity():
    T_true = true_poses(5)
    T_true[:, :3, 3] = 0
    alignment = align_object_frame(true_poses(5), T_true)
    assert alignment.scale > 0
    assert np.isfinite(alignment.offset).all()


def test_an_estimate_without_a_distance_is_still_scored():
    T_true = true_poses(5)
    T_est = np.tile(np.eye(4), (5, 1, 1))
    alignment = align_object_frame(T_est, T_true)
    assert np.isfinite(translation_errors(T_est, T_true, alignment)).all()


def test_the_choice_of_samples_is_repeatable():
    T_true, random = true_poses(), np.random.default_rng(3)
    T_est = estimate(T_true)
    T_est[:, :3, 3] += random.normal(size=(60, 3)) * 0.05
    first, second = (align_object_frame(T_est, T_true, seed=7) for _ in range(2))
    assert first.scale == second.scale


def test_one_frame_agrees_exactly_and_the_scale_is_the_ratio_of_depths():
    T_true = true_poses()
    T_est = estimate(T_true)
    alignment = align_on_frame(T_est[4], T_true[4])
    np.testing.assert_allclose(alignment.poses(T_est[4:5]), T_true[4:5], atol=1e-9)
    assert alignment.scale == pytest.approx(T_true[4, 2, 3] / T_est[4, 2, 3])


def test_with_the_true_scale_the_frame_gives_the_whole_similarity():
    T_true = true_poses()
    assert_known(align_on_frame(estimate(T_true)[0], T_true[0], KNOWN.scale))


def test_a_known_shift_is_the_error_in_diameters_or_in_median_depths():
    T_true = np.tile(np.eye(4), (3, 1, 1))
    T_true[:, 2, 3] = [1.0, 2.0, 4.0]
    T_est = T_true.copy()
    T_est[1, :2, 3] = [0.3, 0.4]
    same = ObjectAlignment(np.eye(3), 1.0, np.zeros(3))
    assert translation_errors(T_est, T_true, same, diameter=0.1) == pytest.approx([0, 5, 0])
    assert translation_errors(T_est, T_true, same) == pytest.approx([0, 0.25, 0])


@pytest.mark.parametrize("frames", [(3, 4), (0, 0)])
def test_frames_that_do_not_pair_are_refused(frames):
    a, b = (np.tile(np.eye(4), (n, 1, 1)) for n in frames)
    with pytest.raises(ValueError, match=rf"\({frames[0]}, 4, 4\) and \({frames[1]}, 4, 4\)"):
        align_object_frame(a, b)


def test_poses_that_are_not_finite_are_refused():
    T = true_poses(4)
    bad = T.copy()
    bad[2, 0, 3] = np.nan
    for one, other in ((bad, T), (T, bad)):
        with pytest.raises(ValueError, match="not finite"):
            align_object_frame(one, other)
    with pytest.raises(ValueError, match=r"\(any, 4, 4\), got \(4, 3, 4\)"):
        align_object_frame(T[:, :3], T)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf, np.nan])
def test_a_scale_that_is_not_positive_is_refused(scale):
    T = true_poses(1)[0]
    with pytest.raises(ValueError, match="positive"):
        align_on_frame(T, T, scale)


@pytest.mark.parametrize("diameter", [0.0, -1.0, np.nan])
def test_a_diameter_that_is_not_positive_is_refused(diameter):
    T = true_poses(4)
    with pytest.raises(ValueError, match="positive"):
        align_object_frame(T, T, diameter)
    with pytest.raises(ValueError, match="positive"):
        translation_errors(T, T, KNOWN, diameter)


def test_depths_of_different_signs_give_no_scale():
    behind = true_poses(1)[0]
    behind[2, 3] = -1.0
    with pytest.raises(ValueError, match="give no scale"):
        align_on_frame(behind, true_poses(1)[0])


def test_no_frames_have_no_errors():
    nothing = np.empty((0, 4, 4))
    assert translation_errors(nothing, nothing, KNOWN).shape == (0,)
