"""Keypoints and descriptors of a grey picture by one small network, in the shape of EdgePoint2 (Yao et al. 2025).

A trunk at strides 2, 8 and 16, descriptors at stride 4 and scores at every pixel. Different from the paper: the
coarsest level is at stride 16 instead of 32, since crops have some 200 pixels, and the picture is also given
normalized by its surroundings, since the light on an object that turns changes from side to side.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

CHANNELS, STRIDE, MULTIPLE = 32, 4, 16
WIDTHS = (8, 8, 24, 32)
"""Channels of the first convolution and of the levels at strides 2, 8 and 16."""

_DETECT = 8  # channels in which the levels are joined for the scores
_GROUP = 16  # channels of a group of the descriptors' 3 x 3 convolution


class KeypointNetwork(nn.Module):
    """``(B, 1, H, W)`` grey in [0, 1], H and W multiples of `MULTIPLE`, to descriptors and scores.

    Descriptors are ``(B, CHANNELS, H / 4, W / 4)``, to be sampled and only then normalized; scores are
    ``(B, 1, H, W)`` logits. Cells lie at the centres of the blocks of pixels that they stand for.
    """

    def __init__(self) -> None:
        super().__init__()
        first, fine, middle, coarse = WIDTHS
        joined = fine + middle + coarse
        self.fine = nn.Sequential(_conv(2, first, 4, 2), _conv(first, fine), _Residual(fine, fine))
        self.middle = _Residual(fine, middle)
        self.coarse = _Residual(middle, coarse)
        self.describe = nn.Sequential(
            nn.Conv2d(joined, joined, 1),
            _conv(joined, joined, groups=joined // _GROUP),
            nn.Conv2d(joined, CHANNELS, 1),
        )
        self.detect = nn.ModuleList([nn.Conv2d(width, _DETECT, 1) for width in WIDTHS[1:]])
        self.score = nn.Sequential(
            nn.Conv2d(_DETECT, _DETECT, 3, padding=1), nn.ReLU(),
            nn.Conv2d(_DETECT, _DETECT, 3, padding=1), nn.ReLU(),
            nn.Conv2d(_DETECT, 4, 3, padding=1), nn.PixelShuffle(2),
        )  # fmt: skip

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Describe and score images."""
        fine = self.fine(normalized(images))
        quarter = functional.avg_pool2d(fine, 2)
        middle = self.middle(functional.avg_pool2d(quarter, 2))
        coarse = self.coarse(functional.avg_pool2d(middle, 2))
        descriptors = self.describe(torch.cat([quarter, _larger(middle, 2), _larger(coarse, 4)], 1))
        parts = zip(self.detect, (fine, middle, coarse), (1, 4, 8), strict=True)
        return descriptors, self.score(sum(_larger(adapt(level), factor) for adapt, level, factor in parts))


class _Residual(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = _conv(inputs, outputs)
        self.second = nn.Sequential(
            nn.Conv2d(outputs, outputs, 3, padding=1, bias=False), nn.BatchNorm2d(outputs)
        )
        self.skip = nn.Identity() if inputs == outputs else nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(self.second(self.first(x)) + self.skip(x))


def normalized(images: Tensor) -> Tensor:
    """``(B, 2, H, W)``: less the mean of the picture and over its deviation, and the same with the 36 pixels around."""
    mean, square = images.mean((2, 3), keepdim=True), (images**2).mean((2, 3), keepdim=True)
    whole = (images - mean) / ((square - mean**2).clamp_min(0).sqrt() + 1e-2)
    small, squares = functional.avg_pool2d(images, 4), functional.avg_pool2d(images**2, 4)
    mean, square = (
        functional.avg_pool2d(x, 9, stride=1, padding=4, count_include_pad=False) for x in (small, squares)
    )
    deviation = (square - mean**2).clamp_min(0).sqrt()
    local = (images - _larger(mean, 4)) / (_larger(deviation, 4) + 0.03)
    return torch.cat([whole, local], 1)


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1, groups: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, 1, bias=False, groups=groups)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


def _larger(x: Tensor, factor: int) -> Tensor:
    if factor == 1:
        return x
    return functional.interpolate(x, scale_factor=float(factor), mode="bilinear", align_corners=False)
