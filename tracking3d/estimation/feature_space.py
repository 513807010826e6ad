"""The features of one sequence: what the encoder gives, or its main components on this object.

Deep features have many channels of which one object uses few. The first mask shows which: a principal component
analysis inside it keeps those that vary over the object, and one factor gives them the spread that the losses are
made for. Rotating and scaling all channels alike keeps what is near to what.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.features.protocol import FeatureEncoder

SPREAD = 0.25
"""Root mean square over the kept channels of their standard deviations inside the first mask: RGB's on a printed
object, and the scale of the Cauchy loss."""

TAU = 0.5
"""Convergence threshold of the appearance loss of features with this spread: frames that are tracked well stay
below 0.45 (measured with s2dnet), and unrelated texels would cost about 0.7."""

_MEDIAN_SIZE = 13  # pixels of the working resolution along the side of the median's window (chosen)
_CONTRAST = 3.0  # factor of the contrast, relative to that of the other channels (chosen)
_LEAST_PIXELS = 16  # in the mask, for a principal component analysis to mean anything


@dataclass(frozen=True, eq=False)
class FeatureSpace:
    """A linear map of feature channels."""

    mean: Tensor  # (C,) what is taken off
    components: Tensor  # (K, C) what it is multiplied by afterwards
    kept: float = 1.0  # share of the variance inside the first mask that is kept, in [0, 1]
    contrast: float = 0.0  # factor of a last channel, see `contrast_of`; 0 without it

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

    def project(self, features: Tensor, image: Tensor | None = None) -> Tensor:
        """Features of this space.

        Args:
            features: ``(C, S, S)`` of the encoder.
            image: ``(3, nS, nS)`` RGB, which they are of; needed for the contrast only.

        Returns:
            ``(K, S, S)``, with the contrast one more.
        """
        projected = torch.einsum("kc,chw->khw", self.components, features - self.mean[:, None, None])
        return projected if image is None else self.add_contrast(projected, image)

    def add_contrast(self, features: Tensor, image: Tensor) -> Tensor:
        """Features of this space ``(K, S, S)`` with the contrast of the image ``(3, nS, nS)`` if that is part of it."""
        if not self.contrast or len(features) > len(self.components):
            return features
        return torch.cat([features, self.contrast * contrast_of(image, features.shape[-1])])

    def with_contrast(self) -> FeatureSpace:
        """The space with a last channel for the contrast of small marks, as a plain object needs it.

        Marks such as a seam or a logo cover so few pixels that their colours hardly count, and light changes the
        colours of all others while the object turns.
        """
        scale = float(self.components.norm()) / math.sqrt(len(self.components))
        return replace(self, contrast=_CONTRAST * scale)


def contrast_of(image: Tensor, size: int) -> Tensor:
    """``(1, size, size)`` by how much each pixel of an RGB image is brighter than the median of those around it.

    It is 0 on plain surface under slowly varying light, and along an edge between two such areas, such as an outline.
    """
    grey = functional.interpolate(image.mean(0)[None, None], size=(size, size), mode="area")
    pixels = (255 * grey[0, 0]).round().byte().cpu().numpy()
    around = torch.from_numpy(cv2.medianBlur(pixels, _MEDIAN_SIZE)).to(grey) / 255
    return grey[0] - around


def feature_channels(encoder: FeatureEncoder, limit: int | None) -> int:
    """Channels of the texture: the encoder's own, or ``limit`` where it has more."""
    return encoder.channels if limit is None else min(encoder.channels, limit)
