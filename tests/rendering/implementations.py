"""The implementations of the renderer, which all have to answer alike."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch


@dataclass(frozen=True)
class Implementation:
    """A backend and the numbers it computes with."""

    backend: str
    dtype: torch.dtype

    def __str__(self) -> str:
        return f"{self.backend} {str(self.dtype).removeprefix('torch.')}"

    @property
    def exact(self) -> bool:
        """Whether rounding can be neglected."""
        return self.dtype == torch.float64


TORCH64 = Implementation("torch", torch.float64)
TORCH32 = Implementation("torch", torch.float32)
NUMBA = Implementation("numba", torch.float32)

everywhere = pytest.mark.parametrize("by", [TORCH64, TORCH32, NUMBA], ids=str)
in_float32 = pytest.mark.parametrize("by", [TORCH32, NUMBA], ids=str)
