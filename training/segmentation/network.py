"""The segmentation network: a U-Net of depthwise-separable blocks with two maps as its answer.

U-Net: Ronneberger et al. 2015; inverted residuals: Sandler et al., MobileNetV2, 2018; sub-pixel output: Shi et al.,
ESPCN, 2016.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

SIZE = 160
"""Side of the crop in pixels; any multiple of `MULTIPLE` works."""

MULTIPLE = 32

CHANNELS = (
    "red", "green", "blue", "mask", "colours", "motion", "first", "cues",
)  # fmt: skip
"""The input: RGB less 0.5; the carried mask or the filled box, 0 to 1; log-odds of the colours divided by 3 and the
motion cue divided by 2, 0 where unknown; 1 if the mask channel is a box; 1 if there are colours."""

OUTPUTS = ("object", "occluder")
"""Logits: of the object as far as it is visible, and of what lies in front of it."""

WIDTHS = (24, 40, 80, 128, 160)
"""Channels at strides 2, 4, 8, 16 and 32."""

_DEPTHS = (1, 2, 3, 4, 2)
_EXPANSION = 3


class SegmentationNetwork(nn.Module):
    """Crops ``(B, 8, S, S)`` to logits ``(B, 2, S, S)``; see `CHANNELS` and `OUTPUTS`."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _conv(len(CHANNELS), WIDTHS[0], 3, 2)
        self.down = nn.ModuleList()
        self.encode = nn.ModuleList()
        for level, (width, depth) in enumerate(zip(WIDTHS, _DEPTHS, strict=True)):
            self.down.append(nn.Identity() if level == 0 else Separable(WIDTHS[level - 1], width, 2))
            self.encode.append(nn.Sequential(*(InvertedResidual(width) for _ in range(depth))))
        self.context = nn.Sequential(
            nn.AdaptiveAvgPool2d(1), nn.Conv2d(WIDTHS[-1], WIDTHS[-1], 1), nn.Hardsigmoid()
        )
        self.lateral = nn.ModuleList()
        self.decode = nn.ModuleList()
        for fine, coarse in zip(WIDTHS[-2::-1], WIDTHS[:0:-1], strict=True):
            self.lateral.append(_conv(coarse, fine, 1, 1))
            self.decode.append(nn.Sequential(Separable(2 * fine, fine, 1), InvertedResidual(fine)))
        self.head = nn.Conv2d(WIDTHS[0], 4 * len(OUTPUTS), 1)

    def forward(self, x: Tensor) -> Tensor:
        """Segment crops."""
        x = self.stem(x)
        levels = []
        for down, encode in zip(self.down, self.encode, strict=True):
            x = encode(down(x))
            levels.append(x)
        x = x * self.context(x)
        for lateral, decode, skip in zip(self.lateral, self.decode, levels[-2::-1], strict=True):
            up = functional.interpolate(lateral(x), scale_factor=2.0, mode="nearest")
            x = decode(torch.cat([up, skip], 1))
        return functional.pixel_shuffle(self.head(x), 2)


class Separable(nn.Module):
    """A depthwise convolution, then one over the channels; with a stride of 2 the map is halved."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        kernel = 5 if stride == 2 else 3
        self.depthwise = _conv(inputs, inputs, kernel, stride, groups=inputs, activation=False)
        self.pointwise = _conv(inputs, outputs, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, inputs, H, W)`` to ``(B, outputs, H / stride, W / stride)``."""
        return self.pointwise(self.depthwise(x))


class InvertedResidual(nn.Module):
    """Channels are widened, filtered one by one, narrowed again and added to what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        wide = width * _EXPANSION if width > WIDTHS[0] else width * 2
        self.widen = _conv(width, wide, 1, 1)
        self.depthwise = _conv(wide, wide, 3, 1, groups=wide)
        self.narrow = _conv(wide, width, 1, 1, activation=False)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, width, H, W)`` to the same shape."""
        return x + self.narrow(self.depthwise(self.widen(x)))


def _conv(
    inputs: int, outputs: int, kernel: int, stride: int, groups: int = 1, activation: bool = True
) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
    layers = [convolution, nn.BatchNorm2d(outputs)]
    return nn.Sequential(*layers, nn.ReLU()) if activation else nn.Sequential(*layers)


def fold_batch_norms(network: nn.Module) -> nn.Module:
    """Put every batch normalization of an evaluating network into the convolution before it."""
    for block in network.modules():
        if isinstance(block, nn.Sequential) and len(block) > 1 and isinstance(block[1], nn.BatchNorm2d):
            block[0] = nn.utils.fuse_conv_bn_eval(block[0], block[1])
            block[1] = nn.Identity()
    return network
