"""The similarity between two runs' objects, against ones that are known."""

from __future__ import annotations

import numpy as np
import pytest
from parts_of_runs import degrees_between, inverse, turning
from scipy.spatial.transform import Rotation

from tracking3d.geometry.similarity import Similarity
from tracking3d.pipeline.submaps.alignment import fit_similarity


def known(seed: int) -> Similarity:
    random = np.random.default_rng(seed)
    return Similarity(
        Rotation.random(random_state=seed).as_matrix(),
        float(random.uniform(0.4, 2.5)),
        random.normal(0, 0.3, 3),
    )


def test_poses_and_points_agree_on_what_a_similarity_is():
    """x_cam of a point is the same by both, up to the scale."""
    similarity, second = known(1), turning(5)
    points = np.random.default_rng(2).normal(size=(7, 3))
    first = similarity.poses(second)
    by_second = points @ np.swapaxes(second[:, :3, :3], 1, 2) + second[:, None, :3, 3]
    moved = similarity.points(points)
    by_first = moved @ np.swapaxes(first[:, :3, :3], 1, 2) + first[:, None, :3, 3]
    np.testing.assert_allclose(by_first, similarity.scale * by_second, atol=1e-12)


def test_one_after_the_other():
    first, second, points = known(3), known(4), np.random.default_rng(5).normal(size=(6, 3))
    np.testing.assert_allclose(first.after(second).points(points), first.points(second.points(points)))
    np.testing.assert_allclose(first.after(inverse(first)).points(points), points, atol=1e-12)
    np.testing.assert_allclose(Similarity.identity().points(points), points)


@pytest.mark.parametrize("seed", range(5))
def test_exact_poses_give_it_exactly(seed):
    truth, first = known(seed), turning(20)
    fit = fit_similarity(first, inverse(truth).poses(first))
    assert degrees_between(fit.similarity.R, truth.R) < 1e-4
    assert fit.similarity.scale == pytest.approx(truth.scale, rel=1e-6)
    np.testing.assert_allclose(fit.similarity.translation, truth.translation, atol=1e-6)
    assert fit.angles.max() < 1e-4
    assert fit.distances.max() < 1e-6


def noisy(poses: np.ndarray, degrees: float, distance: float, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    turned = Rotation.from_rotvec(np.radians(random.normal(0, degrees, (len(poses), 3)))).as_matrix()
    noisy = poses.copy()
    noisy[:, :3, :3] = poses[:, :3, :3] @ turned
    noisy[:, :3, 3] += random.normal(0, distance, (len(poses), 3))
    return noisy


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_averaged_and_a_third_of_wrong_frames_is_not_believed(seed):
    truth, first = known(seed), turning(30)
    second = noisy(inverse(truth).poses(first), 1.0, 0.004, seed)
    wrong = slice(0, 10)
    second[wrong, :3, :3] = Rotation.random(10, random_state=100 + seed).as_matrix()
    second[wrong, :3, 3] += 2.0
    fit = fit_similarity(first, second)
    assert degrees_between(fit.similarity.R, truth.R) < 1.0
    assert fit.similarity.scale == pytest.approx(truth.scale, rel=0.01)
    np.testing.assert_allclose(fit.similarity.translation, truth.translation, atol=0.05 * truth.scale)
    assert np.median(fit.angles) < 3
    assert fit.angles[wrong].min() > 3


def test_landmarks_tell_the_size_where_the_poses_do_not():
    """An object that hardly turns leaves its size and its place on the ray open; its points do not."""
    truth, first = known(7), turning(12, degrees=0.02)
    second = noisy(inverse(truth).poses(first), 0.2, 0.002, 7)
    x_first = np.random.default_rng(8).normal(0, 0.6, (80, 3))
    x_second = inverse(truth).points(x_first) + np.random.default_rng(9).normal(0, 0.01, (80, 3))
    x_second[:20] += 1.0  # a quarter of them are other points
    alone = fit_similarity(first, second)
    together = fit_similarity(first, second, x_first, x_second)
    assert together.similarity.scale == pytest.approx(truth.scale, rel=0.02)
    np.testing.assert_allclose(together.similarity.translation, truth.translation, atol=0.05)
    assert alone.translation_error > 5 * together.translation_error


def test_one_frame_leaves_it_open_and_says_so():
    truth, first = known(1), turning(1)
    fit = fit_similarity(first, inverse(truth).poses(first))
    assert fit.scale_error > 1 or fit.translation_error > 1


def test_the_stated_error_of_the_scale_is_about_the_true_one():
    truth, first = known(2), turning(25)
    scales, stated = [], []
    for seed in range(30):
        fit = fit_similarity(first, noisy(inverse(truth).poses(first), 0.0, 0.01, seed))
        scales.append(fit.similarity.scale / truth.scale - 1)
        stated.append(fit.scale_error)
    assert 0.3 < np.mean(stated) / np.std(scales) < 3


@pytest.mark.parametrize(
    ("first", "second"), [(turning(3), turning(4)), (turning(0), turning(0)), (turning(3)[0], turning(3)[0])]
)
def test_poses_that_do_not_belong_together_are_refused(first, second):
    with pytest.raises(ValueError, match="shapes"):
        fit_similarity(first, second)


def test_points_that_do_not_belong_together_are_refused():
    with pytest.raises(ValueError, match="points"):
        fit_similarity(turning(3), turning(3), np.zeros((4, 3)), np.zeros((5, 3)))
