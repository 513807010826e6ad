"""The training of the feature network: its pairs are true, its losses mean what they say, and it runs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from script_folders import scripts_of

FOLDER = Path(__file__).resolve().parents[2] / "training" / "s2dnet"


@pytest.fixture(autouse=True, scope="module")
def training_modules():
    with scripts_of(FOLDER):
        yield


def smooth_picture(size: int, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (size // 6, size // 6, 3)).astype(np.float32)
    return np.clip(cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC), 0, 255).astype(np.uint8)


def colours_at(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    columns, rows = points.astype(np.float32).T
    return cv2.remap(image, columns[:, None], rows[:, None], cv2.INTER_LINEAR)[:, 0]


@pytest.mark.parametrize("seed", range(5))
def test_points_of_a_warped_pair_show_the_same_colours(seed):
    from pairs import warped_pair

    rng = np.random.default_rng(seed)
    points = rng.uniform(10, 85, (200, 2))
    pair = warped_pair(smooth_picture(144, seed), points, 3, 96, rng, strength=1e-6)
    assert len(pair.order) > 40  # the shift takes the others out of sight
    np.testing.assert_allclose(pair.points[0], points[pair.order], atol=1e-4)
    one, two = (colours_at(image, where) for image, where in zip(pair.images, pair.points, strict=True))
    assert np.abs(one - two).mean() < 0.01

    from pairs import apply_homography, random_homography

    H = random_homography(96, rng, 1.0)
    back = apply_homography(np.linalg.inv(H), apply_homography(H, points))
    np.testing.assert_allclose(back, points, atol=1e-6)


def test_strong_changes_move_points_inside_the_second_image_only():
    from pairs import warped_pair

    rng = np.random.default_rng(0)
    for _ in range(20):
        pair = warped_pair(smooth_picture(144, 1), rng.uniform(5, 90, (50, 2)), 0, 96, rng, strength=1.0)
        assert all(image.shape == (96, 96, 3) and image.dtype == np.float32 for image in pair.images)
        assert all(image.min() >= 0 and image.max() <= 1 for image in pair.images)
        assert ((pair.points[1] > 2) & (pair.points[1] < 93)).all()


def test_points_of_rendered_pairs_are_the_same_surface_points():
    pytest.importorskip("embreex", reason="rendering needs the extra 'synth'")
    from rendered import follow, render_objects, rendered_pair

    (item,) = render_objects(1, 96, [smooth_picture(200, 4)])
    rows, columns = np.nonzero(item.frames[0].visible_mask)
    pixels = np.stack([columns, rows], 1)
    target, seen = follow(item, 0, 1, pixels)
    assert seen.mean() > 0.5
    here = places(item, 0, pixels[seen])
    there = places(item, 1, np.rint(target[seen]).astype(int))
    pixel = item.frames[0].depth.max() / item.K[0, 0]
    assert np.median(np.linalg.norm(here - there, axis=1)) < pixel  # rounded to a pixel
    still = pixels[seen & (item.frames[1].depth[rows, columns] > 0)]
    unmoved = places(item, 0, still) - places(item, 1, still)
    assert np.median(np.linalg.norm(unmoved, axis=1)) > 2 * pixel  # it does move

    pair = rendered_pair(item, 60, np.random.default_rng(0), strength=1.0)
    assert pair.crop == -1
    assert 0 < len(pair.points[0]) == len(pair.points[1]) <= 60


def places(item, frame: int, pixels: np.ndarray) -> np.ndarray:
    """Object coordinates ``(N, 3)`` of what a frame shows at ``pixels`` ``(N, 2)``."""
    T = item.T_cam_obj[frame]
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(item.K).T
    points = rays * item.frames[frame].depth[pixels[:, 1], pixels[:, 0], None]
    return (points - T[:3, 3]) @ T[:3, :3]


def test_the_light_changes_and_the_same_generator_repeats_it():
    from photometry import disturb

    image = smooth_picture(64, 2)
    first, again = (disturb(image, np.random.default_rng(5), 1.0) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - image / 255).mean() > 0.02
    assert np.abs(disturb(image, np.random.default_rng(5), 0.0) - image / 255).max() < 0.01


@pytest.mark.parametrize("stride", [1.0, 2.0])
def test_descriptors_between_cells_are_mixed_of_the_four_around(stride):
    """Cells lie in the middle of their pixels; beyond the map there are zeros."""
    from loss import sample

    generator = torch.Generator().manual_seed(4)
    features = torch.randn(8, 9, 13, generator=generator)
    points = torch.rand(50, 2, generator=generator) * torch.tensor([13.0, 9.0]) * stride - 0.5
    points[0] = torch.tensor([-0.4, 0.0])
    padded = np.pad(features.numpy(), ((0, 0), (1, 1), (1, 1)))
    expected = []
    for x, y in ((points.numpy() + 0.5) / stride - 0.5).tolist():
        left, top = int(np.floor(x)), int(np.floor(y))
        corners = padded[:, top + 1 : top + 3, left + 1 : left + 3]
        mixed = corners @ [left + 1 - x, x - left] @ [top + 1 - y, y - top]
        expected.append(mixed / np.linalg.norm(mixed))
    np.testing.assert_allclose(sample(features, points, stride), np.stack(expected), atol=1e-5)


def test_the_matching_loss_is_low_where_the_truth_is_found_and_high_where_it_is_not():
    from loss import matching_loss, sample

    generator = torch.Generator().manual_seed(0)
    features = torch.nn.functional.normalize(torch.randn(16, 12, 12, generator=generator), dim=0)
    rows, columns = torch.meshgrid(torch.arange(2, 10), torch.arange(2, 10), indexing="ij")
    points = torch.stack([columns, rows], -1).reshape(-1, 2).float() * 2 + 0.5  # centres of cells of stride 2
    exact = sample(features, points, 2)
    torch.testing.assert_close(exact, features[:, rows.flatten(), columns.flatten()].T)
    loss, found = matching_loss(exact, exact, features, points, 2, 1, (0, 0), 0.05, 3.0)
    assert float(found) == 1
    assert float(loss) < 0.1
    loss, found = matching_loss(exact, exact.roll(1, 0), features, points, 2, 1, (0, 0), 0.05, 3.0)
    assert float(found) < 0.2
    assert float(loss) > 5


def test_candidates_near_the_truth_are_no_mistakes():
    from loss import matching_loss

    features = torch.zeros(2, 8, 8)
    features[0] = 1  # every cell looks alike
    query = torch.tensor([[1.0, 0.0]])
    point = torch.tensor([[7.5, 7.5]])
    wide, _ = matching_loss(query, query, features, point, 2, 1, (0, 0), 0.05, 100.0)
    narrow, _ = matching_loss(query, query, features, point, 2, 1, (0, 0), 0.05, 0.1)
    assert float(wide) == pytest.approx(0, abs=1e-4)
    assert float(narrow) == pytest.approx(np.log(65), rel=1e-3)


def test_a_student_that_sees_as_the_teacher_does_has_the_least_distillation_loss():
    from loss import distillation_loss

    teacher = torch.nn.functional.normalize(
        torch.randn(20, 8, generator=torch.Generator().manual_seed(1)), dim=1
    )
    same = distillation_loss(teacher, teacher, teacher, 0.07, 0.07)
    other = distillation_loss(teacher.roll(3, 0), teacher, teacher, 0.07, 0.07)
    assert float(same) == pytest.approx(0, abs=1e-5)
    assert float(other) > 1


def test_slow_shading_is_nearly_gone_after_local_normalization():
    from network import locally_normalized

    picture = torch.from_numpy(smooth_picture(96, 3)).permute(2, 0, 1)[None].float() / 255 * 0.5
    ramp = torch.linspace(0.7, 1.6, 96)
    before = (picture * ramp - picture).abs().mean() / picture.std()
    after = (locally_normalized(picture * ramp) - locally_normalized(picture)).abs().mean()
    assert after / locally_normalized(picture).std() < 0.35 * before


def test_the_network_has_the_shape_and_the_length_that_it_says():
    from network import CHANNELS, STRIDE, DenseFeatures

    torch.manual_seed(0)
    with torch.no_grad():
        features = DenseFeatures().eval()(torch.rand(2, 3, 48, 80))
    assert features.shape == (2, CHANNELS, 48 // STRIDE, 80 // STRIDE)
    torch.testing.assert_close(features.norm(dim=1), torch.ones(2, 48 // STRIDE, 80 // STRIDE))


@pytest.mark.slow
def test_a_short_training_writes_a_network_that_the_encoder_can_run(tmp_path):
    pytest.importorskip("embreex", reason="rendering needs the extra 'synth'")
    pytest.importorskip("onnx", reason="the export needs the package onnx")
    from export import export
    from recipe import read_recipe
    from tracking3d.features.networks.session import Network
    from train import train

    pictures = tmp_path / "photographs"
    pictures.mkdir()
    for seed in range(3):
        cv2.imwrite(str(pictures / f"{seed}.png"), smooth_picture(500, seed))
    recipe = {"photographs": [str(pictures)], "cutouts": [], "size": 32, "crops": 3, "objects": 1, "points": 60,
              "steps": 50, "warped_pairs": 1, "rendered_pairs": 1, "warm_up": 5, "checkpoint_every": 25}  # fmt: skip
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(recipe), encoding="utf-8")
    threads = torch.get_num_threads()
    try:
        train(read_recipe(tmp_path / "recipe.yaml"), tmp_path / "out")
    finally:
        torch.set_num_threads(threads)
    header, row = (tmp_path / "out" / "losses.csv").read_text(encoding="utf-8").split()
    assert header == "step,seconds,matching,found,distillation"
    assert row.startswith("50,")
    export(tmp_path / "out" / "checkpoint.pt", tmp_path / "network.onnx")
    network = Network(tmp_path / "network.onnx")
    answer = network.run({"image": np.zeros((1, 3, 32, 48), np.float32)})["features"]
    assert answer.shape == (1, 128, 16, 24)
    assert np.isfinite(answer).all()
