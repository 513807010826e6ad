"""What the network is trained on."""

from __future__ import annotations

import torch
from kornia.geometry.transform import remap
from torch import Tensor
from torch.nn import functional


def sample(features: Tensor, points: Tensor, stride: float) -> Tensor:
    """Unit descriptors ``(N, C)`` of one map ``(C, h, w)`` at points ``(N, 2)`` in pixels of the image."""
    columns, rows = ((points + 0.5) / stride - 0.5).T  # cells lie in the middle of their pixels
    values = remap(features[None], columns[None, None], rows[None, None], align_corners=True)
    return functional.normalize(values[0, :, 0].T, dim=1)


def matching_loss(
    queries: Tensor, truths: Tensor, features: Tensor, points: Tensor, stride: int, step: int, offset: tuple[int, int],
    temperature: float, radius: float,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Cross entropy of finding each query in the whole of the other image (S2DNet, section 3).

    Args:
        queries: ``(N, C)`` unit descriptors of points of one image.
        truths: ``(N, C)`` those of the same points in the other image.
        features: ``(C, h, w)`` the other image's map.
        points: ``(N, 2)`` where they are in it, in pixels.
        stride: Of the map.
        step: Every so many cells of the map are candidates, in rows and columns.
        offset: Of the first candidate.
        temperature: Of the softmax.
        radius: Candidates nearer to the truth, in pixels, are no mistakes.

    Returns:
        The mean loss, and the share of queries whose truth beats all candidates.
    """
    candidates = features[:, offset[0] :: step, offset[1] :: step]
    rows = torch.arange(candidates.shape[1]) * step + offset[0]
    columns = torch.arange(candidates.shape[2]) * step + offset[1]
    y, x = (stride * (cells + 0.5) - 0.5 for cells in (rows, columns))
    distance = (points[:, None, 1] - y).square()[:, :, None] + (points[:, None, 0] - x).square()[:, None]
    wrong = (queries @ candidates.flatten(1)).masked_fill((distance < radius**2).flatten(1), -1.0)
    right = (queries * truths).sum(1, keepdim=True)
    logits = torch.cat([right, wrong], 1) / temperature
    target = torch.zeros(len(logits), dtype=torch.long)
    return functional.cross_entropy(logits, target), (logits.argmax(1) == 0).float().mean()


def distillation_loss(
    queries: Tensor, truths: Tensor, teacher: Tensor, temperature: float, teacher_temperature: float
) -> Tensor:
    """Points should be as alike to each other as they are for the teacher, who saw them in clear light.

    Args:
        queries: ``(N, C)`` unit descriptors of one image.
        truths: ``(N, C)`` of the same points in the other image.
        teacher: ``(N, D)`` the teacher's of these points.
        temperature: Of the student's softmax over all points.
        teacher_temperature: Of the teacher's.
    """
    wanted = functional.softmax(teacher @ teacher.T / teacher_temperature, dim=1)
    found = functional.log_softmax(queries @ truths.T / temperature, dim=1)
    return functional.kl_div(found, wanted, reduction="batchmean")
