"""Turns about an axis of symmetry do not count; where the axis points does."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d_bench.evaluation.axis_symmetry import (
    aligned_axis_errors,
    anchored_axis_errors,
    consecutive_axis_errors,
    tilts,
)

AXIS = np.array([0.0, 1.0, 0.0])


def about(axis, degrees):
    return Rotation.from_rotvec(np.radians(degrees) * np.asarray(axis, float)).as_matrix()


@pytest.fixture
def true():
    """40 rotations of all kinds."""
    return Rotation.random(40, random_state=0).as_matrix()


def spun(R, seed=1):
    """The same but for a turn of its own about the axis in every frame, and one other object frame."""
    turns = np.random.default_rng(seed).uniform(0, 360, len(R))
    frame = Rotation.random(random_state=5).as_matrix()
    return np.stack([one @ about(AXIS, turn) @ frame.T for one, turn in zip(R, turns, strict=True)])


@pytest.mark.parametrize("errors", [aligned_axis_errors, anchored_axis_errors, consecutive_axis_errors])
def test_any_turn_about_the_axis_and_any_object_frame_is_no_error(true, errors):
    assert errors(spun(true), true, AXIS) == pytest.approx(0, abs=1e-6)
    assert errors(spun(true), true, 7 * AXIS) == pytest.approx(0, abs=1e-6)


def test_one_frame_whose_axis_leans_is_off_by_how_much_it_leans(true):
    estimated = spun(true)
    estimated[7] = about([1.0, 0, 0], 12) @ about(true[7] @ AXIS, 99) @ true[7] @ (true[3].T @ estimated[3])
    lean = np.degrees(np.arccos((about([1.0, 0, 0], 12) @ true[7] @ AXIS) @ (true[7] @ AXIS)))
    errors = aligned_axis_errors(estimated, true, AXIS)
    assert errors[7] == pytest.approx(lean, abs=1e-6)
    assert np.delete(errors, 7) == pytest.approx(0, abs=1e-6)
    steps = consecutive_axis_errors(estimated, true, AXIS)
    assert steps[[6, 7]] == pytest.approx(lean, abs=1e-5) and np.delete(steps, [6, 7]) == pytest.approx(
        0, abs=1e-5
    )


@pytest.mark.parametrize("first", [0, 20])
def test_upside_down_is_half_a_turn_off_and_does_not_pull_the_others(true, first):
    estimated = spun(true)
    estimated[first : first + 5] = (
        true[first : first + 5] @ about([1.0, 0, 0], 180) @ (true[10].T @ estimated[10])
    )
    errors = aligned_axis_errors(estimated, true, AXIS)
    assert errors[first : first + 5] == pytest.approx(180, abs=1e-5)
    assert np.delete(errors, range(first, first + 5)) == pytest.approx(0, abs=1e-5)


def test_anchored_errors_inherit_the_first_frames(true):
    estimated = spun(true)
    estimated[0] = about([0, 0, 1.0], 20) @ estimated[0]
    lean = np.degrees(np.arccos((about([0, 0, 1.0], 20) @ true[0] @ AXIS) @ (true[0] @ AXIS)))
    errors = anchored_axis_errors(estimated, true, AXIS)
    assert errors[0] == pytest.approx(0, abs=1e-6) and errors[1:] == pytest.approx(lean, abs=1e-5)
    assert aligned_axis_errors(estimated, true, AXIS)[1:] == pytest.approx(0, abs=1e-6)


def test_the_median_has_no_larger_sum_than_any_axis_nearby(true):
    rng = np.random.default_rng(3)
    noise = Rotation.from_rotvec(rng.normal(0, 0.2, (40, 3))).as_matrix()
    estimated = noise @ spun(true)
    best = aligned_axis_errors(estimated, true, AXIS).sum()
    seen = np.einsum("nji,njk,k->ni", estimated, true, AXIS)
    for direction in rng.normal(size=(3000, 3)) * 0.2 + seen.mean(0):
        angles = np.degrees(np.arccos(np.clip(seen @ direction / np.linalg.norm(direction), -1, 1)))
        assert best <= angles.sum() + 1e-6


@pytest.mark.parametrize(
    ("count", "axis", "message"),
    [(0, AXIS, "equal shapes"), (2, np.zeros(3), "length 0"), (2, AXIS[:2], "axis")],
)
def test_what_has_no_error_is_refused(true, count, axis, message):
    with pytest.raises(ValueError, match=message):
        aligned_axis_errors(true[:count], true[:count], axis)


def test_a_tilt_is_the_angle_between_named_and_true_axis_whichever_way_they_point() -> None:
    R_est = np.stack(
        [about([0, 0, 1], lean) @ about(AXIS, turn) for lean, turn in ((0, 10), (7, 250), (30, 90))]
    )
    R_true = np.repeat(np.eye(3)[None], 3, 0)
    axes = np.array([[0, 1, 0], [0, 1, 0], [0, -1, 0]], float)
    found = tilts(R_est, axes, R_true, [0.0, 2.0, 0.0])
    np.testing.assert_allclose(found, [0, 7, 30], atol=1e-6)
