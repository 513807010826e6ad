"""Kornia's descriptors as dense features: those that are dense, and those of patches, one patch around every pixel.

Kornia would fetch the weights of a network when it is built; here they come from a file that the user names.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, Self

import torch
from kornia.color import rgb_to_grayscale
from kornia.contrib import extract_tensor_patches
from kornia.feature import DISK, DenseSIFTDescriptor, HardNet, HardNet8, HyNet, SOSNet, TFeat
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn
from torch.nn import functional

from tracking3d.errors import InputError
from tracking3d.features.weight_files import load_weights

_PATCH = 32  # pixels along a side, of all of kornia's networks for patches
_MULTIPLE = 16  # pixels by which DISK's sides are divided
_OF_PATCHES: dict[str, Callable[..., nn.Module]] = {
    "hardnet": HardNet,
    "hardnet8": HardNet8,
    "hynet": HyNet,
    "sosnet": SOSNet,
    "tfeat": TFeat,
}


class KorniaEncoder:
    """Encoder ``kornia``: 128 channels of length 1 from one of kornia's descriptors.

    ``dense-sift`` needs no weights and answers at stride 2, ``disk`` at stride 1, descriptors of patches at
    ``stride``.

    Args:
        descriptor: Which; see ``Options``.
        network: It, with its weights; None for ``dense-sift``.
        stride: Of descriptors of patches.

    Attributes:
        channels: 128.
        stride: Input pixels per feature pixel.
        tau: Convergence threshold of the appearance loss; the paper's for deep features.
    """

    channels = 128
    tau = 0.05

    class Options(BaseModel):
        """Options of ``kornia``."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        descriptor: Literal["dense-sift", "disk", "hardnet", "hardnet8", "hynet", "sosnet", "tfeat"] = Field(
            "dense-sift", description="Which of kornia's descriptors; all but dense-sift need weights."
        )
        weights: str | None = Field(
            None, description="File of the weights, .safetensors, .pth or .pt; nothing is fetched."
        )
        stride: Literal[2, 4, 8] = Field(4, description="Pixels between patches, for descriptors of patches.")

    def __init__(self, descriptor: str, network: nn.Module | None = None, stride: int = 4) -> None:
        self._descriptor = descriptor
        if network is None:
            # Sixteen cells of four pixels: with this padding the answers lie in the middle of their two pixels.
            network, stride = DenseSIFTDescriptor(stride=2, padding=5), 2
        elif descriptor == "disk":
            stride = 1
        self._network = network.eval().requires_grad_(False)
        self.stride = stride

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the network and load its weights.

        Raises:
            InputError: If it needs weights and none are named, or they cannot be used.
        """
        given = cls.Options.model_validate(options.model_dump())
        if given.descriptor == "dense-sift":
            if given.weights is not None:
                raise InputError(
                    "features.weights: dense-sift has no weights; name another features.descriptor."
                )
            return cls(given.descriptor)
        if given.weights is None:
            raise InputError(
                f"features.weights: {given.descriptor} needs the file of its weights, and nothing is fetched; give its "
                "path, or take dense-sift, which needs none."
            )
        network = DISK() if given.descriptor == "disk" else _OF_PATCHES[given.descriptor](pretrained=False)
        load_weights(network, Path(given.weights).expanduser(), given.descriptor)
        return cls(given.descriptor, network, given.stride)

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1] as ``(B, 128, H / stride, W / stride)``; sizes are rounded down."""
        images = images.float()
        network = self._network.to(images.device)
        if isinstance(network, DISK):
            height, width = images.shape[-2:]
            padded = functional.pad(images, (0, -width % _MULTIPLE, 0, -height % _MULTIPLE), mode="replicate")
            dense = network.heatmap_and_dense_descriptors(padded)[1][..., :height, :width]
        elif isinstance(network, DenseSIFTDescriptor):
            dense = network(rgb_to_grayscale(images))
        else:
            dense = self._of_patches(network, rgb_to_grayscale(images))
        return functional.normalize(dense, dim=1)

    def _of_patches(self, network: nn.Module, grey: Tensor) -> Tensor:
        """``(B, 128, H / stride, W / stride)`` of ``(B, 1, H, W)``: each of the patch around its pixels' middle."""
        views, _, height, width = grey.shape
        rows, columns = height // self.stride, width // self.stride
        border = (_PATCH - self.stride) // 2
        grey = functional.pad(
            grey[..., : rows * self.stride, : columns * self.stride], (border,) * 4, mode="replicate"
        )
        patches = extract_tensor_patches(grey, _PATCH, self.stride)  # (B, rows columns, 1, _PATCH, _PATCH)
        described: Tensor = network(patches.flatten(0, 1))
        return described.reshape(views, rows, columns, -1).permute(0, 3, 1, 2)
