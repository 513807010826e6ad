"""The network that comes with the package: ready, small, precise, and hardly moved by light."""

from __future__ import annotations

from importlib import resources

import pytest
import torch

from tracking3d.features.rgb import RgbEncoder
from tracking3d.features.s2dnet import S2DNetEncoder
from tracking3d.testing import check_encoder
from tracking3d_bench.benchmark.feature_encoders import build_encoders, painted_images
from tracking3d_bench.benchmark.matching import make_pairs, matching_scores


@pytest.fixture(scope="module")
def encoder() -> S2DNetEncoder:
    return S2DNetEncoder()


def picture(size: tuple[int, int], seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, size[0] // 8, size[1] // 8, generator=generator)
    return torch.nn.functional.interpolate(coarse, size=size, mode="bicubic").clamp(0, 1)


def test_it_passes_the_checks_for_encoders():
    check_encoder(S2DNetEncoder)


def test_its_file_is_under_five_megabytes():
    file = resources.files("tracking3d.features") / "weights" / "s2dnet.onnx"
    assert len(file.read_bytes()) < 5_000_000


@pytest.mark.parametrize("size", [(64, 96), (128, 128), (50, 71), (17, 16)])
def test_any_size_gives_unit_features_at_stride_two(encoder, size):
    features = encoder.encode(picture(size))
    assert features.shape == (1, 128, size[0] // 2, size[1] // 2)
    torch.testing.assert_close(features.norm(dim=1), torch.ones(1, size[0] // 2, size[1] // 2))


def test_features_move_with_the_image(encoder):
    image = picture((96, 480))
    moved = torch.roll(image, 16, dims=3)
    here, there = encoder.encode(image), encoder.encode(moved)
    same = (here[..., 100:132] * there[..., 108:140]).sum(1)  # far from what came in at the border
    assert float(same.min()) > 0.99


def test_features_do_not_say_where_in_the_image_they_lie(encoder):
    """A pattern that repeats must look alike in the corners as in the middle, and a flat image everywhere."""
    tile = picture((64, 64), seed=3)
    features = encoder.encode(tile.repeat(1, 1, 4, 4))[0]
    repeats = features.unflatten(1, (4, 32)).unflatten(3, (4, 32))  # 64 pixels are 32 cells
    same = torch.einsum("crhsw,chw->rhsw", repeats, repeats[:, 1, :, 1, :])[:, 8:-8, :, 8:-8]
    assert float(same.mean((1, 3)).min()) > 0.93
    flat = encoder.encode(torch.full((1, 3, 256, 256), 0.5))[0]
    assert float((flat[:, 4, 4] * flat[:, 64, 64]).sum()) > 0.99


def test_light_changes_features_far_less_than_another_place_does(encoder):
    image = picture((128, 128))
    ramp = torch.linspace(0.6, 1.3, 128)
    lit = (0.8 * image * ramp) ** 1.4 * torch.tensor([1.0, 0.85, 0.75])[:, None, None]
    plain, changed = encoder.encode(image), encoder.encode(lit)
    same = (plain * changed).sum(1).mean()
    elsewhere = (plain * torch.roll(changed, (13, 21), (2, 3))).sum(1).mean()
    assert float(same) > 0.7
    assert float(elsewhere) < 0.4


def test_it_finds_more_in_another_light_than_colours_do(encoder):
    pairs = make_pairs(painted_images()[:3], 0, 128)
    deep, colours = (matching_scores(e.encode, pairs) for e in (encoder, RgbEncoder()))
    assert deep.everywhere > colours.everywhere + 0.3
    assert deep.nearby > 0.8


@pytest.mark.slow
def test_alike_n_finds_no_more_on_photographs_that_neither_saw(encoder, shared_models):
    data = pytest.importorskip("skimage.data", reason="scikit-image's photographs are not installed")
    photographs = [data.astronaut(), data.chelsea(), data.coffee(), data.rocket()]
    alike = build_encoders([f"onnx:model={shared_models / 'alike-n_dense.onnx'},description=alike"])["onnx"]
    pairs = make_pairs(photographs, 0, 256)
    ours, theirs = (matching_scores(e.encode, pairs) for e in (encoder, alike))
    assert ours.everywhere >= theirs.everywhere
    assert ours.nearby >= theirs.nearby
