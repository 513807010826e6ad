"""Dense ALIKED features (Zhao et al. 2023) by kornia: an example of a tracking3d plug-in that runs in torch."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

import torch
from kornia.feature import ALIKED
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from tracking3d.errors import InputError
from tracking3d_aliked.weights import read_weights

_NOT_DENSE = ("desc_head.", "dkd.")  # sparse keypoints and descriptors, which are not used here


class AlikedEncoder:
    """Encoder ``aliked``: features of length 1 at full resolution; 128 channels, 64 in the variant t16.

    It fulfils the protocol ``tracking3d.features.protocol.FeatureEncoder``.

    Args:
        network: ALIKED with its weights.

    Attributes:
        channels: Feature channels.
        stride: 1.
        tau: Convergence threshold of the appearance loss; the paper's for deep features.
    """

    stride = 1
    tau = 0.05

    class Options(BaseModel):
        """What can be set in YAML under ``features:`` or with ``--set features.<name>=...``."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        weights: str = Field(description="File of the weights: .safetensors, .pth or .pt.")
        variant: Literal["t16", "n16", "n16rot", "n32"] = Field(
            "n16", description="Which network of the family the weights are for."
        )

    def __init__(self, network: ALIKED) -> None:
        self._network = network.eval().requires_grad_(False)
        self.channels = 4 * network.conv4.out_channels

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the network and load its weights.

        Raises:
            InputError: If the file cannot be read or does not hold the weights of this variant.
        """
        given = cls.Options.model_validate(options.model_dump())
        file = Path(given.weights).expanduser()
        weights = read_weights(file)
        network = ALIKED(f"aliked-{given.variant}")
        wanted = {
            name: value.shape
            for name, value in network.state_dict().items()
            if not name.startswith(_NOT_DENSE) and not name.endswith("num_batches_tracked")
        }
        missing = [
            name for name, shape in wanted.items() if name not in weights or weights[name].shape != shape
        ]
        if missing:
            raise InputError(
                f"{file} does not hold the weights of ALIKED-{given.variant}: {missing[0]} is missing or of another "
                "size; give the file of this variant, or set features.variant."
            )
        network.load_state_dict({name: weights[name] for name in wanted}, strict=False)
        return cls(network)

    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1] as ``(B, C, H, W)``."""
        with torch.no_grad():
            return self._network.to(images.device).extract_dense_map(images.float())[0]
