"""A dense feature network after S2DNet: a convolutional backbone, an adaptation layer at each of its levels, and
the sum of them as descriptors (Germain et al., S2DNet, ECCV 2020, section 4; far smaller, and at stride 2).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

CHANNELS, STRIDE, MULTIPLE = 128, 2, 16
WIDTHS = (32, 64, 96, 128)
"""Channels of the backbone at strides 2, 4, 8 and 16."""

CONTEXT = 64
"""Channels in which the coarser levels are joined."""


class DenseFeatures(nn.Module):
    """RGB images to unit descriptors.

    Images are ``(B, 3, H, W)`` in [0, 1], H and W multiples of `MULTIPLE`; the answer is
    ``(B, CHANNELS, H / STRIDE, W / STRIDE)``, of length 1 along the channels. Cells lie at the centres of the
    blocks of pixels that they stand for.
    """

    def __init__(self) -> None:
        super().__init__()
        fine, middle, coarse, coarsest = WIDTHS
        self.level1 = nn.Sequential(_conv(6, fine, 4, 2), _conv(fine, fine))
        self.level2 = nn.Sequential(_conv(fine, middle, 2, 2), _conv(middle, middle), _conv(middle, middle))
        self.level3 = nn.Sequential(_conv(middle, coarse, 2, 2), _conv(coarse, coarse), _conv(coarse, coarse))
        self.level4 = nn.Sequential(
            _conv(coarse, coarsest, 2, 2), _conv(coarsest, coarsest), _conv(coarsest, coarsest)
        )
        self.adapt4 = nn.Conv2d(coarsest, CONTEXT, 1)
        self.adapt3 = nn.Conv2d(coarse, CONTEXT, 1)
        self.adapt2 = nn.Conv2d(middle, CONTEXT, 1)
        self.join2 = _conv(CONTEXT, CONTEXT)
        self.describe2 = nn.Conv2d(CONTEXT, CHANNELS, 1)
        self.describe1 = nn.Conv2d(fine, CHANNELS, 1)
        self.register_buffer("ones", torch.ones(1, CHANNELS, 1, 1), persistent=False)
        self.ones: Tensor

    def forward(self, images: Tensor) -> Tensor:
        """Describe images."""
        level1 = self.level1(torch.cat([images - 0.5, locally_normalized(images)], 1))
        level2 = self.level2(level1)
        level3 = self.level3(level2)
        level4 = self.level4(level3)
        joined = self.adapt3(level3) + _doubled(self.adapt4(level4))
        joined = self.join2(self.adapt2(level2) + _doubled(joined))
        features = self.describe1(level1) + _doubled(self.describe2(joined))
        # As a convolution: onnxruntime's reduction over channels takes a fifth of the whole network's time.
        length = functional.conv2d(features**2, self.ones).clamp_min(1e-12).sqrt()
        return features / length


def locally_normalized(images: Tensor) -> Tensor:
    """``(B, 3, H, W)`` less the mean of the surrounding 36 pixels, over their deviation: no slow shading is left."""
    small = functional.avg_pool2d(images, 4)
    squares = functional.avg_pool2d(images**2, 4)
    mean, square = (
        functional.avg_pool2d(x, 9, stride=1, padding=4, count_include_pad=False) for x in (small, squares)
    )
    deviation = (square - mean**2).clamp_min(0).sqrt()
    mean, deviation = (
        functional.interpolate(x, scale_factor=4.0, mode="bilinear", align_corners=False)
        for x in (mean, deviation)
    )
    return (images - mean) / (2 * deviation + 0.06)


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    # Zeros beyond the border would tell every cell where in the image it lies, and features would say so.
    padding = (kernel - stride + 1) // 2
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False, padding_mode="replicate")
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


def _doubled(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
