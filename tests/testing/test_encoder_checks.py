"""``check_encoder`` finds every fault that it is there for, and passes encoders that have none."""

from __future__ import annotations

from typing import Self

import numpy as np
import pytest
import torch
from pydantic import BaseModel
from torch import Tensor, nn
from torch.nn import functional

from tracking3d.errors import InputError
from tracking3d.plugins import FEATURES, list_plugins, load_plugin
from tracking3d.testing import check_encoder


class PooledEncoder:
    """Means of four by four pixels; the broken ones below differ in one thing each."""

    channels = 3
    stride = 4
    tau = 0.1

    class Options(BaseModel):
        gain: float = 1.0

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        return cls(options.gain)

    def encode(self, images: Tensor) -> Tensor:
        return functional.avg_pool2d(images, 4) * self.gain


class CeilingEncoder(PooledEncoder):
    def encode(self, images):
        return functional.avg_pool2d(images, 4, ceil_mode=True)


class RefusesOddSizes(PooledEncoder):
    def encode(self, images):
        if images.shape[-1] % 4:
            raise InputError("The images are not a multiple of 4 pixels wide; choose another window.size.")
        return super().encode(images)


class NoChannels(PooledEncoder):
    channels = None


class HalfStride(PooledEncoder):
    stride = 0.5


class NegativeTau(PooledEncoder):
    tau = -1.0


class OtherChannels(PooledEncoder):
    channels = 16


class OtherStride(PooledEncoder):
    stride = 2


class Flat(PooledEncoder):
    def encode(self, images):
        return super().encode(images).flatten(1)


class FirstOnly(PooledEncoder):
    def encode(self, images):
        return super().encode(images)[:1]


class SquareOnly(PooledEncoder):
    def encode(self, images):
        return super().encode(functional.interpolate(images, (64, 64)))


class Doubles(PooledEncoder):
    def encode(self, images):
        return super().encode(images).double()


class Arrays(PooledEncoder):
    def encode(self, images):
        return super().encode(images).numpy()


class Elsewhere(PooledEncoder):
    def encode(self, images):
        return super().encode(images).to("meta")


class InPlace(PooledEncoder):
    def encode(self, images):
        return super().encode(images.mul_(2).sub_(1))


class UnitLength(PooledEncoder):
    """Divides by a length that is zero for black images."""

    def encode(self, images):
        features = super().encode(images)
        return features / features.norm(dim=1, keepdim=True)


class BatchMean(PooledEncoder):
    def encode(self, images):
        return super().encode(images) - images.mean()


class TrainingNetwork(PooledEncoder):
    def __init__(self, gain: float = 1.0) -> None:
        self.network = nn.Conv2d(3, 3, 4, 4)

    def encode(self, images):
        return self.network(images)


class Dropout(PooledEncoder):
    def encode(self, images):
        return functional.dropout(super().encode(images), 0.5, training=True)


class NumpyNoise(PooledEncoder):
    def encode(self, images):
        return super().encode(images) + float(np.random.random())


class GlobalSwitch(PooledEncoder):
    def encode(self, images):
        torch.set_grad_enabled(False)
        return super().encode(images)


class Constant(PooledEncoder):
    def encode(self, images):
        return torch.ones_like(super().encode(images))


class Raises(PooledEncoder):
    def encode(self, images):
        if images.shape[-1] % 32:
            raise RuntimeError("sizes of tensors must match")
        return super().encode(images)


class CannotBeBuilt(PooledEncoder):
    @classmethod
    def from_options(cls, options):
        raise OSError("no such file")


BROKEN = {
    NoChannels: "its channels is None instead of a positive integer",
    HalfStride: "its stride is 0.5 instead of a positive integer",
    NegativeTau: "its tau is -1.0 instead of a positive number",
    OtherChannels: r"features have shape \(1, 3, 16, 16\) instead of \(1, 16, 16, 16\)",
    OtherStride: r"features have shape \(1, 3, 16, 16\) instead of \(1, 3, 32, 32\)",
    Flat: r"features have shape \(1, 768\)",
    FirstOnly: r"3 images of 64 x 64 pixels: its features have shape \(1, 3, 16, 16\) instead of \(3,",
    SquareOnly: r"1 images of 128 x 64 pixels: its features have shape \(1, 3, 16, 16\) instead of \(1, 3, 16, 32\)",
    Doubles: "float64 instead of float32",
    Arrays: "returned a ndarray of float32 instead of a tensor",
    Elsewhere: "its features are on meta, but the images on cpu",
    InPlace: "the encoder has changed the images; work on a copy",
    UnitLength: "a black image: its features are not all finite",
    BatchMean: "Image 0 of a batch has other features than alone",
    TrainingNetwork: r"carry gradients.*torch\.no_grad",
    Dropout: "has other features than alone|same images twice gives different features",
    NumpyNoise: "has other features than alone|same images twice gives different features",
    GlobalSwitch: "has switched gradients off globally",
    Constant: "Two different images have equal features",
    Raises: "an image of 68 x 68 pixels raises RuntimeError: sizes of tensors must match",
    CannotBeBuilt: "Building it raises OSError: no such file",
}


@pytest.fixture(autouse=True)
def gradients():
    with torch.enable_grad():
        yield


@pytest.mark.parametrize(
    ("encoder", "told"), BROKEN.items(), ids=lambda value: getattr(value, "__name__", "")
)
def test_every_fault_is_found_and_told_in_a_sentence(encoder, told):
    with pytest.raises(AssertionError, match=told) as caught:
        check_encoder(encoder)
    sentence = str(caught.value).partition("\nassert")[0]
    assert sentence.endswith(".") and "\n" not in sentence


class SeededNoise(PooledEncoder):
    """Depends on the global generator alone, so that the batch is not what gives it away."""

    def encode(self, images):
        return super().encode(images) + torch.initial_seed() % 97


def test_what_depends_on_the_seed_alone_is_found():
    with pytest.raises(AssertionError, match="same images twice gives different features"):
        check_encoder(SeededNoise)


@pytest.mark.parametrize("encoder", [PooledEncoder, CeilingEncoder, RefusesOddSizes])
def test_an_encoder_without_a_fault_passes(encoder):
    check_encoder(encoder)
    check_encoder(encoder())
    check_encoder(lambda: encoder(0.5))


def test_a_class_is_built_from_its_options():
    with pytest.raises(AssertionError, match="equal features"):
        check_encoder(PooledEncoder, gain=0.0)


NEED_NO_FILES = [
    info.name
    for info in list_plugins()
    if (info.group, info.package, info.status) == (FEATURES, "tracking3d", "ok")
    and not (info.options or {}).get("required")
]


@pytest.mark.parametrize("name", NEED_NO_FILES)
def test_built_in_encoders_conform(name):
    check_encoder(load_plugin(FEATURES, name))
