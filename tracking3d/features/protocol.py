"""The protocol of feature encoders: what the appearance loss compares instead of raw pixels.

A plug-in is a class registered under the entry-point group ``tracking3d.features``. It knows tensors, never
the pipeline.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, Self, runtime_checkable

from pydantic import BaseModel

if TYPE_CHECKING:
    from torch import Tensor


@runtime_checkable
class FeatureEncoder(Protocol):
    """Turns images into dense feature maps.

    A class that implements it has a nested pydantic model ``Options`` and a classmethod
    ``from_options(options)``.

    Attributes:
        channels: Number of feature channels C.
        stride: Input pixels per feature pixel.
        tau: Convergence threshold of the appearance loss for these features (paper section 3.4: 0.2 for RGB,
            0.05 for S2DNet).
    """

    channels: int
    stride: int
    tau: float

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build an encoder from its validated ``Options``."""
        ...

    def encode(self, images: Tensor) -> Tensor:
        """Encode ``(B, 3, H, W)`` RGB in [0, 1] as ``(B, C, H / stride, W / stride)``."""
        ...
