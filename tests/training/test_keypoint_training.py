"""The training of the keypoint network: sizes of its answers, what its losses mean, and that it learns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from script_folders import scripts_of

FOLDER = Path(__file__).resolve().parents[2] / "training" / "keypoints"


@pytest.fixture(autouse=True, scope="module")
def training_modules():
    with scripts_of(FOLDER):
        yield


@pytest.mark.parametrize("size", [(64, 96), (208, 112)])
def test_descriptors_have_a_quarter_of_the_size_and_scores_all_of_it(size):
    from network import CHANNELS, KeypointNetwork

    height, width = size
    network = KeypointNetwork().eval()
    with torch.no_grad():
        descriptors, scores = network(torch.rand(1, 1, height, width))
    assert descriptors.shape == (1, CHANNELS, height // 4, width // 4)
    assert scores.shape == (1, 1, height, width)
    assert sum(one.numel() for one in network.parameters()) < 50_000


def test_brightness_and_contrast_of_the_picture_change_little_of_what_the_network_sees():
    from network import normalized

    picture = torch.rand(1, 1, 64, 64)
    assert (normalized(picture) - normalized(0.5 * picture + 0.3)).abs().max() < 0.3


def test_points_are_found_where_descriptors_agree_and_nowhere_else():
    from train import STRIDE, _matching

    torch.manual_seed(0)
    maps = torch.nn.functional.normalize(torch.randn(1, 2, 32, 16, 16), dim=2)
    cells = torch.cartesian_prod(torch.arange(2, 14), torch.arange(2, 14))[::5].float()
    points = STRIDE * cells + (STRIDE - 1) / 2
    points = torch.cat([points, torch.full((3, 2), torch.nan)])[None, None].repeat(1, 2, 1, 1)
    apart, share = _matching(maps, maps, points)
    assert share < 0.2
    maps = maps[:, :1].repeat(1, 2, 1, 1, 1)
    alike, share = _matching(maps, maps, points)
    assert share == 1 and alike < 0.1 < apart


def test_a_few_steps_write_a_network_that_can_be_exported(tmp_path):
    pytest.importorskip("onnx")
    import export
    import train

    random = np.random.default_rng(0)
    count = train.HELD_OUT + 2
    np.savez(
        tmp_path / "pool.npz",
        images=random.integers(0, 255, (count, 2, 32, 32), dtype=np.uint8),
        points=random.uniform(4, 28, (count, 2, 8, 2)).astype(np.float32),
        scores=random.normal(-6, 2, (count, 2, 32, 32)).astype(np.float16),
        descriptors=random.normal(size=(count, 2, 32, 8, 8)).astype(np.float16),
    )
    train.train(tmp_path / "pool.npz", tmp_path / "out", 0.5)
    export.export(tmp_path / "out" / "network.pt", tmp_path / "keypoints.onnx")
    header, row = (tmp_path / "out" / "losses.csv").read_text().splitlines()[:2]
    assert len(header.split(",")) == len(row.split(",")) == 8
