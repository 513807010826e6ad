"""Losses of the two maps, and the measure of validation."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def map_loss(logits: Tensor, target: Tensor, weight: Tensor, overlap: float) -> Tensor:
    """Cross entropy, more of it at the outline, and one less the soft intersection over union.

    Args:
        logits: ``(B, H, W)``.
        target: ``(B, H, W)`` in [0, 1].
        weight: ``(B,)``, 0 for what is not known.
        overlap: Weight of the second part, which counts only where there is something.
    """
    entropy = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    around = functional.avg_pool2d(target[:, None], 9, 1, 4, count_include_pad=False)[:, 0]
    outline = 1 + 2 * (4 * around * (1 - around))
    per_sample = (entropy * outline).mean((1, 2))
    present = (target.flatten(1).amax(1) > 0.5).float()
    probability = torch.sigmoid(logits)
    common = (probability * target).sum((1, 2))
    union = (probability + target - probability * target).sum((1, 2))
    per_sample = per_sample + overlap * present * (1 - (common + 1) / (union + 1))
    return (weight * per_sample).sum() / weight.sum().clamp_min(1)


def intersection_over_union(logits: Tensor, target: Tensor) -> Tensor:
    """``(B,)`` of the maps at their thresholds; 1 where both are empty."""
    one, two = logits > 0, target > 0.5
    union = (one | two).flatten(1).sum(1)
    return torch.where(union > 0, (one & two).flatten(1).sum(1) / union.clamp_min(1), 1.0)
