"""Kornia's descriptors as features: where they lie, and weights from files alone."""

from __future__ import annotations

import kornia.feature
import numpy as np
import pytest
import torch
from kornia.color import rgb_to_grayscale
from kornia.feature import DISK, HardNet, HyNet, SOSNet, TFeat

from tracking3d import load_config, track
from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError
from tracking3d.features.kornia_descriptors import KorniaEncoder
from tracking3d.plugins import FEATURES, VARIABLE, build_plugin
from tracking3d.testing import check_encoder
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize

PLUGIN = "tracking3d.features:kornia=tracking3d.features.kornia_descriptors:KorniaEncoder"


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Whatever kornia would fetch fails the test."""
    monkeypatch.setenv(VARIABLE, PLUGIN)

    def refuse(*arguments, **named):
        raise AssertionError(f"asked the network for {arguments}")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    for name in ("hardnet", "hynet", "sosnet", "tfeat", "disk.disk"):
        module = __import__(f"kornia.feature.{name}", fromlist=["load_state_dict_from_url"])
        if hasattr(module, "load_state_dict_from_url"):
            monkeypatch.setattr(module, "load_state_dict_from_url", refuse)


def encoder(**options) -> KorniaEncoder:
    return build_plugin(FEATURES, PluginChoice(name="kornia", **options))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Networks that were never trained: what is tested is what is made of them."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    networks = {
        "hardnet": HardNet(False),
        "sosnet": SOSNet(False),
        "tfeat": TFeat(False),
        "hynet": HyNet(False),
    }
    for name, network in {**networks, "disk": DISK()}.items():
        state = network.state_dict()
        torch.save({"extractor": state} if name == "disk" else {"state_dict": state}, folder / f"{name}.pth")
    return folder


def test_dense_sift_is_a_whole_encoder_without_weights():
    check_encoder(KorniaEncoder)


@pytest.mark.parametrize(
    ("name", "stride"), [("disk", 1), ("hardnet", 8), ("sosnet", 8), ("tfeat", 8), ("hynet", 8)]
)
def test_features_have_their_stride_and_length_one(weights, name, stride):
    made = encoder(descriptor=name, weights=str(weights / f"{name}.pth"), stride=8)
    features = made.encode(torch.rand(2, 3, 49, 66, generator=torch.Generator().manual_seed(1)))
    assert made.stride == stride
    assert features.shape == (2, 128, 49 // stride, 66 // stride)
    torch.testing.assert_close(features.norm(dim=1), torch.ones_like(features[:, 0]))


@pytest.fixture(scope="module")
def symmetric() -> torch.Tensor:
    """A picture that is its own mirror image."""
    coarse = torch.rand(1, 1, 16, 16, generator=torch.Generator().manual_seed(2))
    picture = torch.nn.functional.interpolate(coarse, size=(64, 64), mode="bicubic").clamp(0, 1)
    return ((picture + picture.flip(3)) / 2).expand(1, 3, 64, 64)


def test_dense_sift_lies_in_the_middle_of_its_pixels(symmetric):
    """Mirroring exchanges cells and angles, but not how much there is in each row of cells; a shift would."""
    features = encoder().encode(symmetric)[..., 8:-8, 8:-8]
    rows = features.square().reshape(1, 8, 4, 4, *features.shape[2:]).sum((1, 3))
    torch.testing.assert_close(rows, rows.flip(3), atol=2e-3, rtol=0)


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_patches_lie_around_the_middle_of_their_pixels(symmetric, stride):
    seen = []

    class Sees(torch.nn.Module):
        def forward(self, patches):
            seen.append(patches)
            return torch.ones(len(patches), 128)

    KorniaEncoder("hardnet", Sees(), stride).encode(symmetric)
    row = seen[0][: 64 // stride]
    torch.testing.assert_close(row, row.flip(0, 3))


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_patches_are_windows_of_the_picture_one_after_another(stride):
    """Two pictures whose sides are no multiples; beyond the border the outermost pixels go on."""
    seen = []

    class Sees(torch.nn.Module):
        def forward(self, patches):
            seen.append(patches)
            return torch.ones(len(patches), 128)

    pictures = torch.rand(2, 1, 21, 34, generator=torch.Generator().manual_seed(3))
    KorniaEncoder("hardnet", Sees(), stride).encode(pictures.expand(2, 3, 21, 34))
    whole = rgb_to_grayscale(pictures.expand(2, 3, 21, 34)).numpy()
    rows, columns = 21 // stride, 34 // stride
    whole, border = whole[..., : stride * rows, : stride * columns], (32 - stride) // 2
    padded = np.pad(whole, ((0, 0), (0, 0), (border, border), (border, border)), mode="edge")
    expected = [
        picture[:, stride * row : stride * row + 32, stride * column : stride * column + 32]
        for picture in padded
        for row in range(rows)
        for column in range(columns)
    ]
    assert (seen[0].numpy() == np.stack(expected)).all()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"descriptor": "hardnet"},
            r"^features.weights: hardnet needs a weights file, .*none is downloaded",
        ),
        ({"descriptor": "disk"}, r"^features.weights: disk needs a weights file"),
        ({"weights": "x.pth"}, r"^features.weights: dense-sift has no weights"),
        ({"descriptor": "hardnet", "weights": "nowhere.pth"}, r"^The weights nowhere.pth do not exist"),
    ],
)
def test_weights_that_are_not_there_are_asked_for(options, sentence):
    with pytest.raises(InputError, match=sentence):
        encoder(**options)


def test_weights_of_another_network_and_other_files_are_refused(weights, tmp_path):
    with pytest.raises(
        InputError, match=r"tfeat\.pth does not hold the weights of hardnet: features\.0\.weight"
    ):
        encoder(descriptor="hardnet", weights=str(weights / "tfeat.pth"))
    text, other = tmp_path / "text.pth", tmp_path / "other.pth"
    text.write_text("no weights")
    torch.save([1, 2], other)
    with pytest.raises(InputError, match=r"text\.pth cannot be read as weights"):
        encoder(descriptor="hardnet", weights=str(text))
    with pytest.raises(InputError, match=r"other\.pth holds no state dict"):
        encoder(descriptor="hardnet", weights=str(other))


def test_an_object_is_tracked_with_them():
    clip = synthesize(SyntheticSpec(frames=2, size=(80, 64)))
    config = load_config(overrides=["crop.size=64", "solver.final_refine=false"], features="kornia")
    assert len(list(track(clip.images, mask=clip.masks[0], config=config))) == 2


def test_kornia_s_networks_are_those_of_the_options():
    names = KorniaEncoder.Options.model_fields["descriptor"].annotation.__args__
    assert {"HardNet", "HardNet8", "HyNet", "SOSNet", "TFeat", "DISK"} <= set(dir(kornia.feature))
    assert len(names) == 7
