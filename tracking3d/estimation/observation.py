"""One frame as the solvers see it: features and mask in a window of the one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tracking3d.estimation.outline import outline_distance
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window
from tracking3d.rendering import PoseTarget, channels_last


@dataclass(frozen=True, eq=False)
class Observation:
    """A window of one frame, ``S`` x ``S`` pixels.

    Attributes:
        index: The frame's index in the source.
        window: Where in the frame.
        K: ``(3, 3)`` the camera's intrinsics in the window.
        image: ``(3, 2 S, 2 S)`` RGB in [0, 1], finer than the rest: it becomes the visible texture.
        features: ``(C, S, S)``.
        valid: ``(S, S)`` 1 inside the frame, 0 beyond its border, where nothing is known.
        mask: ``(S, S)`` rough mask in [0, 1]; all zero where there is none.
        distance: ``(S, S)`` distance to the mask in NDC, zero inside it.
        has_mask: Whether the mask tracker gave a mask.
    """

    index: int
    window: Window
    K: Tensor
    image: Tensor
    features: Tensor
    valid: Tensor
    mask: Tensor
    distance: Tensor
    has_mask: bool

    @cached_property
    def half(self) -> Observation:
        """At half the working resolution."""
        return halved(self)

    @cached_property
    def outline_distance(self) -> Tensor:
        """``(S, S)`` see `tracking3d.estimation.outline.outline_distance`."""
        return outline_distance(self.mask, self.valid)

    @cached_property
    def target(self) -> PoseTarget:
        """What poses are fitted to."""
        # What covers the object, or lies beside it, is left out of the comparison: the mask is to show it.
        return PoseTarget(
            self.K,
            channels_last(self.features[None])[0],
            self.valid * self.mask if self.has_mask else self.valid,
            self.valid > 0.5,
            self.mask > 0.5 if self.has_mask else None,
            self.outline_distance if self.has_mask else None,
        )


@dataclass(frozen=True, eq=False)
class ObservationBatch:
    """Several observations stacked: the same fields with a leading ``(B,)``, see `Observation`."""

    index: Tensor
    K: Tensor
    features: Tensor
    valid: Tensor
    mask: Tensor
    distance: Tensor
    has_mask: Tensor

    @classmethod
    def of(cls, observations: list[Observation]) -> ObservationBatch:
        """Stack observations."""
        device = observations[0].features.device
        return cls(
            torch.tensor([o.index for o in observations], device=device),
            torch.stack([o.K for o in observations]),
            channels_last(torch.stack([o.features for o in observations])),
            torch.stack([o.valid for o in observations]),
            torch.stack([o.mask for o in observations]),
            torch.stack([o.distance for o in observations]),
            torch.tensor([float(o.has_mask) for o in observations], device=device),
        )


def observe(
    frame: Frame,
    mask: NDArray[np.bool_] | None,
    window: Window,
    camera: Camera,
    encoder: FeatureEncoder,
    device: torch.device,
) -> Observation:
    """Cut the window out of a frame and encode it."""
    rows, columns, border = _within(window, *frame.size)
    pixels = torch.tensor(np.ascontiguousarray(frame.image[rows, columns]), device=device)
    pixels = functional.pad(pixels.permute(2, 0, 1).float() / 255, border)
    image, detail = _resampled(pixels, window.size), _resampled(pixels, 2 * window.size)
    valid = torch.ones(window.size, window.size, device=device)
    if any(border):
        inside = torch.ones(1, rows.stop - rows.start, columns.stop - columns.start, device=device)
        valid = _resampled(functional.pad(inside, border), window.size)[0].ge(0.5).float()
    # Features of a stride above 1 are cut out of the finer image, so as not to be coarser than the rest.
    features = encoder.encode((image if encoder.stride == 1 else detail)[None])
    if features.shape[-1] != window.size:
        features = functional.interpolate(
            features, size=(window.size, window.size), mode="bilinear", antialias=True
        )
    if mask is None or not mask.any():
        soft = distance = torch.zeros_like(valid)
    else:
        there = torch.from_numpy(mask[rows, columns]).to(device).float()
        soft = _resampled(functional.pad(there[None], border), window.size)[0]
        distance = mask_distance(soft)
    K = torch.tensor(window.K(camera), dtype=torch.float32, device=device)
    known = mask is not None and bool(soft.any())
    return Observation(frame.index, window, K, detail, features[0].float(), valid, soft, distance, known)


def halved(observation: Observation) -> Observation:
    """The same observation at half the working resolution."""
    half = replace(observation.window, size=observation.window.size // 2)
    scale = observation.K.new_tensor([0.5, 0.5, 1.0])
    K = observation.K * scale[:, None]
    K[:2, 2] -= 0.25  # pixel centres stay at integers

    def pool(image: Tensor) -> Tensor:
        return functional.avg_pool2d(image.reshape(1, -1, *image.shape[-2:]), 2)[0].reshape(
            *image.shape[:-2], half.size, half.size
        )

    return replace(
        observation,
        window=half,
        K=K,
        features=pool(observation.features),
        valid=pool(observation.valid).ge(0.75).float(),
        mask=pool(observation.mask),
        distance=pool(observation.distance),
    )


def crop(image: Tensor, window: Window) -> Tensor:
    """Resample ``(C, H, W)`` into the window: ``(C, S, S)``, antialiased, zero beyond the border."""
    rows, columns, border = _within(window, *image.shape[-2:])
    return _resampled(functional.pad(image[:, rows, columns], border), window.size)


def _within(window: Window, height: int, width: int) -> tuple[slice, slice, tuple[int, int, int, int]]:
    """Rows and columns of an image that a window sees, and how far it reaches beyond: left, right, above, below."""
    (columns, *across), (rows, *along) = (
        _span(first, window.side, size) for first, size in ((window.left, width), (window.top, height))
    )
    return rows, columns, (across[0], across[1], along[0], along[1])


def _span(first: int, count: int, size: int) -> tuple[slice, int, int]:
    """What of ``count`` places from ``first`` on lies in ``range(size)``, and how many come before and after it."""
    begin = min(max(first, 0), size)
    end = max(min(first + count, size), begin)
    before = min(max(-first, 0), count)
    return slice(begin, end), before, count - before - (end - begin)


def _resampled(image: Tensor, size: int) -> Tensor:
    """``(C, side, side)`` at ``size`` x ``size`` pixels, antialiased."""
    return functional.interpolate(image[None], size=(size, size), mode="bilinear", antialias=True)[0]


def mask_distance(mask: Tensor) -> Tensor:
    """Distance of every pixel of ``(S, S)`` to the mask, in NDC (half the window's side is 1).

    OpenCV's exact transform: the target is constant, so nothing is differentiated through it, and kornia's
    differentiable one is an approximation. The last bit of OpenCV's roots depends on where the image lies in memory;
    the squares are whole numbers, so they are taken once more.
    """
    outside = (mask < 0.5).cpu().numpy().astype(np.uint8)
    if outside.all():
        return torch.zeros_like(mask)
    pixels = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    exact = np.sqrt(np.rint(np.square(pixels)))
    return torch.from_numpy(exact).to(mask) * (2.0 / mask.shape[-1])
