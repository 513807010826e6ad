"""The features of one sequence: what the encoder gives, or its main components on this object.

Deep features have many channels of which one object uses few. The first mask shows which: a principal component
analysis inside it keeps those that vary over the object, and one factor gives them the spread that the losses are
made for. Rotating and scaling all channels alike keeps what is near to what.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.features.protocol import FeatureEncoder

SPREAD = 0.25
"""Root mean square over the kept channels of their standard deviations inside the first mask: RGB's on a printed
object, and the scale of the Cauchy loss."""

TAU = 0.5
"""Convergence threshold of the appearance loss of features with this spread: frames that are tracked well stay
below 0.45 (measured with s2dnet), and unrelated texels would cost about 0.7."""

_LEAST_PIXELS = 16  # in the mask, for a principal component analysis to mean anything


@dataclass(frozen=True, eq=False)
class FeatureSpace:
    """A linear map of feature channels.

    Attributes:
        mean: ``(C,)`` what is taken off.
        components: ``(K, C)`` what it is multiplied by afterwards.
        kept: Share of the variance inside the first mask that is kept, in [0, 1].
    """

    mean: Tensor
    components: Tensor
    kept: float = 1.0

    @classmethod
    def of(cls, features: Tensor, mask: Tensor, channels: int) -> FeatureSpace:
        """The main components inside a mask.

        Args:
            features: ``(C, S, S)``, C at least ``channels``.
            mask: ``(S, S)`` in [0, 1].
            channels: How many are kept.
        """
        inside = features[:, mask > 0.5].T
        if len(inside) < _LEAST_PIXELS:
            inside = features.flatten(1).T
        mean = inside.mean(0)
        centred = (inside - mean).double()
        variances, directions = torch.linalg.eigh(centred.T @ centred / len(centred))
        kept, total = variances[-channels:].sum(), variances.sum()
        # Ascending eigenvalues; the sign of an eigenvector is free, so it is fixed by its largest entry.
        components = directions[:, -channels:].flip(1).T
        largest = components.gather(1, components.abs().argmax(1, keepdim=True))
        scale = SPREAD / (kept / channels).clamp_min(1e-12).sqrt()
        components = (components * largest.sign() * scale).to(features)
        return cls(mean, components, float(kept / total.clamp_min(1e-12)))

    def project(self, features: Tensor) -> Tensor:
        """``(C, S, S)`` features as ``(K, S, S)``."""
        centred = features - self.mean[:, None, None]
        return torch.einsum("kc,chw->khw", self.components, centred)


def feature_channels(encoder: FeatureEncoder, limit: int | None) -> int:
    """Channels of the texture: the encoder's own, or ``limit`` where it has more."""
    return encoder.channels if limit is None else min(encoder.channels, limit)
