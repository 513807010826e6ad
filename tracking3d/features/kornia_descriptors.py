"""Kornia's descriptors as dense features: dense ones, and patch descriptors with one patch around every pixel.

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

    ``dense-sift`` needs no weights and has stride 2, ``disk`` stride 1, patch descriptors ``stride``.

    Args:
        descriptor: Which; see ``Options``.
        network: It, with its weights; None for ``dense-sift``.
        stride: Stride of descriptors of patches.

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
            "dense-sift", description="The kornia descriptor; all but dense-sift need weights."
        )
        weights: str | None = Field(
            None, description="Weights file: .safetensors, .pth or .pt; nothing is downloaded."
        )
        stride: Literal[2, 4, 8] = Field(4, description="Pixels between patches, for patch descriptors.")

    def __init__(self, descriptor: str, network: nn.Module | None = None, stride: int = 4) -> None:
        self._descriptor = descriptor
        if network is None:
            # Sixteen cells of four pixels: with this padding the features lie in the middle of their two
            # pixels.
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
                    "features.weights: dense-sift has no weights; choose another features.descriptor."
                )
            return cls(given.descriptor)
        if given.weights is None:
            raise InputError(
                f"features.weights: {given.descriptor} needs a weights file, and none is downloaded; give "
                "its path, or use dense-sift, which needs none."
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


_WRAPPED = ("state_dict", "extractor", "model")
"""Keys under which checkpoints store the weights."""


def read_weights(file: Path) -> dict[str, Tensor]:
    """The tensors of a ``.safetensors``, ``.pth`` or ``.pt`` file by name.

    Args:
        file: The file; one that holds them under ``state_dict``, ``extractor`` or ``model`` will do.

    Raises:
        InputError: If there is no such file, or it holds anything but tensors.
    """
    if not file.is_file():
        raise InputError(f"The weights {file} do not exist; give the path of a file that you have.")
    try:
        if file.suffix == ".safetensors":
            import safetensors.torch

            return safetensors.torch.load_file(file)
        loaded = torch.load(file, map_location="cpu", weights_only=True)
    except ImportError as error:
        raise InputError(f"{file} needs the package safetensors; install it, or give a .pth file.") from error
    except Exception as error:  # damaged files make the readers raise many kinds
        raise InputError(
            f"{file} cannot be read as weights, or holds objects other than tensors, which are not loaded; "
            "give a .safetensors "
            "file, or a .pth file with a state dict."
        ) from error
    for key in _WRAPPED:
        if isinstance(loaded, dict) and isinstance(loaded.get(key), dict):
            loaded = loaded[key]
    if not isinstance(loaded, dict) or not all(isinstance(value, Tensor) for value in loaded.values()):
        raise InputError(f"{file} holds no state dict of tensors; give the weights alone.")
    return loaded


def load_weights(network: nn.Module, file: Path, name: str) -> None:
    """Put the weights of a file into a network, all of them.

    Args:
        network: The network.
        file: See `read_weights`.
        name: What messages call the network.

    Raises:
        InputError: If they cannot be read, or are of another network.
    """
    weights, wanted = read_weights(file), network.state_dict()
    wrong = [
        key
        for key, value in wanted.items()
        if not key.endswith("num_batches_tracked")
        and (key not in weights or weights[key].shape != value.shape)
    ]
    if wrong:
        raise InputError(
            f"{file} does not hold the weights of {name}: {wrong[0]} is missing or of another size; give its file, or "
            "set features.descriptor."
        )
    network.load_state_dict({key: weights[key] for key in wanted if key in weights}, strict=False)
