"""The training of the segmentation network: its answer has the size of the crop, its losses mean what they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from script_folders import scripts_of

FOLDER = Path(__file__).resolve().parents[2] / "training" / "segmentation"


@pytest.fixture(autouse=True, scope="module")
def training_modules():
    with scripts_of(FOLDER):
        yield


def disc(radius: float) -> torch.Tensor:
    rows, columns = np.mgrid[:64, :64]
    return torch.tensor(np.hypot(rows - 32, columns - 32) < radius, dtype=torch.float32)[None]


@pytest.mark.parametrize("size", [(64, 96), (160, 160)])
def test_the_network_answers_with_two_maps_of_the_size_of_the_crop(size):
    from network import CHANNELS, SegmentationNetwork

    network = SegmentationNetwork().eval()
    with torch.no_grad():
        assert network(torch.rand(2, len(CHANNELS), *size)).shape == (2, 2, *size)
    assert sum(one.numel() for one in network.parameters()) < 2e6


def test_folded_normalizations_change_no_answer():
    from network import CHANNELS, SegmentationNetwork, fold_batch_norms

    torch.manual_seed(0)
    network, crops = SegmentationNetwork(), torch.rand(4, len(CHANNELS), 64, 64)
    with torch.no_grad():
        for _ in range(20):
            network.train()(crops)
        expected = network.eval()(crops)
        folded = fold_batch_norms(network)
        assert not any(isinstance(one, torch.nn.BatchNorm2d) for one in folded.modules())
        assert torch.allclose(folded(crops), expected, atol=1e-3 * float(expected.abs().max()))


def test_the_loss_is_least_for_the_truth_and_ignores_what_is_not_known():
    from loss import map_loss

    truth, one = disc(20), torch.ones(1)
    right, wrong = (8 * (2 * mask - 1) for mask in (truth, disc(10)))
    assert map_loss(right, truth, one, 0.5) < 0.1 < map_loss(wrong, truth, one, 0.5)
    both = torch.cat([right, wrong]), torch.cat([truth, truth])
    assert map_loss(*both, torch.tensor([1.0, 0.0]), 0.5) == pytest.approx(
        float(map_loss(right, truth, one, 0.5))
    )


def test_the_loss_weighs_an_error_at_the_outline_more_than_one_deep_inside():
    from loss import map_loss

    truth, one = disc(20), torch.ones(1)
    right = 4 * (2 * truth - 1)
    at_outline, inside = right.clone(), right.clone()
    at_outline[0, 32, 32 + 18] *= -1
    inside[0, 32, 32] *= -1
    assert map_loss(at_outline, truth, one, 0.0) > map_loss(inside, truth, one, 0.0)


def test_intersection_over_union_counts_pixels_and_is_one_if_both_are_empty():
    from loss import intersection_over_union

    one, two = disc(20), disc(10)
    found = intersection_over_union(torch.cat([two, two, 0 * one]) - 0.5, torch.cat([one, two, 0 * one]))
    assert found.tolist() == pytest.approx([float(two.sum() / one.sum()), 1.0, 1.0])


def test_a_mask_without_mistakes_stays_and_strong_mistakes_leave_it_a_mask():
    from mask_errors import damaged

    truth = disc(20)[0].numpy()
    image = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    overlaps = []
    for seed in range(30):
        found = damaged(truth, image, [], np.random.default_rng(seed), 1.0)
        assert found.shape == truth.shape and found.min() >= 0 and found.max() <= 1
        overlaps.append(float((np.minimum(found, truth).sum()) / np.maximum(found, truth).sum()))
    assert max(overlaps) == pytest.approx(1.0, abs=1e-6)  # some have no mistake
    assert np.mean(np.array(overlaps) < 0.95) > 0.3


def test_the_learning_rate_rises_stays_and_falls_to_nothing():
    from recipe import Recipe
    from train import learning_rate, progress

    recipe = Recipe(
        photos="a", masks="b", pool="c", steps=1000, warm_up=100, cool_down=0.3, learning_rate=1.0
    )
    rates = [
        learning_rate(step, progress(step, 0.0, recipe), recipe) for step in (0, 50, 100, 700, 850, 1000)
    ]
    assert rates == pytest.approx([0.0, 0.5, 1.0, 1.0, 0.5, 0.0])
    short = recipe.model_copy(update={"seconds": 60.0})
    assert progress(10, 30.0, short) == 0.5
    assert progress(900, 30.0, short) == 0.9
    assert learning_rate(500, progress(500, 60.0, short), short) == 0.0


def test_gaps_are_cut_into_the_alpha_of_a_cut_out_and_leave_one_part_of_it():
    import cv2

    from gaps import with_gaps

    layer = np.random.default_rng(0).integers(0, 255, (120, 90, 4), dtype=np.uint8)
    whole = cv2.ellipse(np.zeros((120, 90), np.uint8), (45, 60), (40, 55), 0, 0, 360, 255, -1)
    layer[..., 3] = whole
    shares = []
    for seed in range(60):
        cut = with_gaps(layer, np.random.default_rng(seed))
        assert cut.shape == layer.shape and cut.dtype == np.uint8
        assert np.array_equal(cut[..., :3], layer[..., :3])
        assert (cut[..., 3] <= whole).all()
        assert cv2.connectedComponents((cut[..., 3] > 127).astype(np.uint8))[0] == 2
        shares.append(float(cut[..., 3].sum() / whole.sum()))
    assert np.array_equal(layer[..., 3], whole)
    assert np.array_equal(
        with_gaps(layer, np.random.default_rng(3)), with_gaps(layer, np.random.default_rng(3))
    )
    assert 0.14 < min(shares) < 0.4
    assert np.mean(np.array(shares) < 0.95) > 0.8


def test_a_network_that_begins_with_exported_weights_answers_as_the_exported_one(tmp_path):
    pytest.importorskip("onnx")
    from batches import SamplePool
    from first_weights import load_exported
    from network import CHANNELS, SegmentationNetwork
    from scene_sequences import CANVAS, PLANES
    from tracking3d.features.networks.session import Network

    samples = np.random.default_rng(0).integers(0, 255, (4, len(PLANES), CANVAS, CANVAS), dtype=np.uint8)
    np.save(tmp_path / "train_0000.npy", samples)
    (tmp_path / "train_0000.csv").write_text("kind,knows_occluder\n" + 4 * "still,0\n", encoding="utf-8")
    file = FOLDER.parents[1] / "tracking3d" / "trackers" / "weights" / "segmentation.onnx"
    network = SegmentationNetwork()
    load_exported(network, file, SamplePool(tmp_path, "train"))
    crops = torch.rand(2, len(CHANNELS), 64, 64)
    with torch.no_grad():
        found = network.eval()(crops).numpy()
    expected = Network(file).run({"crop": crops.numpy()})["logits"]
    assert np.allclose(found, expected, atol=1e-3 * np.abs(expected).max())
