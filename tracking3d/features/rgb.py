"""The identity encoder: features are the RGB values themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from torch import Tensor


class RgbEncoder:
    """Identity features: three channels, stride one (paper section 3.1)."""

    channels = 3
    stride = 1
    tau = 0.2

    class Options(BaseModel):
        """The identity has no options."""

        model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the encoder; there is nothing to configure."""
        return cls()

    def encode(self, images: Tensor) -> Tensor:
        """Return ``(B, 3, H, W)`` unchanged."""
        return images
