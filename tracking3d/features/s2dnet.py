"""Illumination-robust deep features: a dense network after S2DNet, trained by this project."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Self

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from torch import Tensor

_MULTIPLE = 16
"""The network downsamples images by two four times."""


class S2DNetEncoder:
    """Encoder ``s2dnet``: 128 channels of length 1 at stride 2, from an ONNX network that comes with the package.

    It is small and takes after S2DNet (Germain et al., ECCV 2020), whose features the paper uses; neither its
    weights nor its code are that project's. How it was trained: ``training/s2dnet``.
    """

    channels = 128
    stride = 2
    tau = 0.05

    class Options(BaseModel):
        """Options of ``s2dnet``."""

        model_config = ConfigDict(extra="forbid", frozen=True)

        threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")

    def __init__(self, threads: int = 1) -> None:
        from tracking3d.features.networks.session import Network

        with resources.as_file(resources.files("tracking3d.features") / "weights" / "s2dnet.onnx") as file:
            self._network = Network(Path(file), threads)

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the encoder from its validated options."""
        return cls(cls.Options.model_validate(options.model_dump()).threads)

    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1] as ``(B, 128, H / 2, W / 2)``; sizes are rounded down."""
        import torch
        from torch.nn import functional

        height, width = images.shape[-2:]
        border = (0, -width % _MULTIPLE, 0, -height % _MULTIPLE)
        padded = functional.pad(images, border, mode="replicate") if any(border) else images
        answer = self._network.run({"image": padded.detach().cpu().float().numpy()})["features"]
        features = torch.from_numpy(answer).to(images.device)
        return features[..., : height // self.stride, : width // self.stride]
