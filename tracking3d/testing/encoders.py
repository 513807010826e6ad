"""Conformance checks of feature encoders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from tracking3d.features.protocol import FeatureEncoder
from tracking3d.plugins.guard import attribute_fault, feature_fault
from tracking3d.testing.plugins import allow_refusal, expect_success, factory_of, random_state

_TOLERANCE = 1e-4
"""Largest difference, relative to the largest feature, between an image encoded alone and in a batch."""


def check_encoder(
    encoder: type[Any] | Callable[[], FeatureEncoder] | FeatureEncoder,
    *,
    size: int = 64,
    device: str = "cpu",
    **options: Any,
) -> None:
    """Check that a feature encoder keeps to its protocol, `tracking3d.features.protocol.FeatureEncoder`.

    Channels, stride and tau; shapes for one image and for several, square or not; type, device and finite values,
    also on black and white images; the same features again and in a batch; different features for different
    images; images left unchanged; nothing left behind for gradients. Sizes that its stride does not divide it may
    refuse, by a `tracking3d.errors.InputError` of one sentence.

    Args:
        encoder: The plug-in's class, a function that builds one, or an encoder.
        size: Side of the images in pixels; a multiple of what the encoder needs, and at least 32.
        device: Where the images are.
        options: The plug-in's own options, where ``encoder`` is its class.

    Raises:
        AssertionError: If it does not; the sentence says what was expected.
    """
    with expect_success("Building it"):
        built = factory_of(encoder, ("encode",), options)()
    fault = attribute_fault(built)
    assert not fault, f"{type(built).__name__}: {fault}."
    random = torch.Generator().manual_seed(0)
    for height, width in ((size, size), (size, 2 * size), (2 * size, size)):
        _encode(built, torch.rand(1, 3, height, width, generator=random).to(device))
    images = torch.rand(3, 3, size, size, generator=random).to(device)
    _check_batch(built, images)
    _check_repeatable(built, images)
    for name, value in (("black", 0.0), ("white", 1.0)):
        _encode(built, torch.full_like(images[:1], value), f"a {name} image")
    for side in (size + 4, size - 1):
        what = f"an image of {side} x {side} pixels"
        odd = torch.rand(1, 3, side, side, generator=random).to(device)
        with allow_refusal(what):
            features = built.encode(odd)
            fault = feature_fault(features, odd, built)
            assert not fault, f"{what}: {fault}."


def _encode(encoder: FeatureEncoder, images: Tensor, what: str = "") -> Tensor:
    what = what or f"{images.shape[0]} images of {images.shape[3]} x {images.shape[2]} pixels"
    before = images.clone()
    enabled = torch.is_grad_enabled()
    with expect_success(what):
        features = encoder.encode(images)
    assert torch.is_grad_enabled() == enabled, (
        f"{what}: the encoder has switched gradients {'off' if enabled else 'on'} globally; use "
        "torch.no_grad() as a context."
    )
    fault = feature_fault(features, images, encoder)
    assert not fault, f"{what}: {fault}."
    assert features.dtype == torch.float32, (
        f"{what}: the features are of {features.dtype} instead of float32."
    )
    assert not features.requires_grad, (
        f"{what}: the features carry gradients, which keeps every frame in memory; encode under torch.no_grad()."
    )
    assert torch.equal(images, before), f"{what}: the encoder has changed the images; work on a copy."
    return features.clone()


def _check_batch(encoder: FeatureEncoder, images: Tensor) -> None:
    together = _encode(encoder, images)
    largest = float(together.abs().max())
    for position in range(len(images)):
        alone = _encode(encoder, images[position : position + 1])
        difference = float((together[position : position + 1] - alone).abs().max())
        assert difference <= _TOLERANCE * max(largest, 1e-12), (
            f"Image {position} of a batch has other features than alone (difference {difference:g}); encode "
            "each image independently."
        )
    assert not torch.allclose(together[0], together[1]), "Two different images have equal features."


def _check_repeatable(encoder: FeatureEncoder, images: Tensor) -> None:
    runs = []
    for seed in (1, 2):
        with random_state(seed):
            runs.append(_encode(encoder, images))
    assert torch.equal(*runs), (
        "Encoding the same images twice gives different features; disable dropout and take random seeds "
        "from the options."
    )
