"""The loss terms of the paper (section 3.3), each for itself and for every frame where it has frames.

Silhouettes, masks and distances are ``(B, H, W)``; ``valid`` is 0 beyond the frame's border, where nothing is
known and nothing is charged.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.geometry.pose import Pose, rotation_angle

_SMALL = 1e-10


def appearance_loss(
    pixel_loss: Tensor,
    pixels: Tensor,
    valid: Tensor,
    scale: float,
    seen: Tensor | None = None,
    unseen_penalty: float = 0.0,
) -> Tensor:
    """Appearance loss, eq. 1, for each frame: the mean Cauchy loss over the object's visible pixels.

    The mean over the object makes the threshold tau independent of the window; over the whole window, where most
    pixels are zero, 0.2 would be reached before anything has moved.

    Only covered pixels take part: there the soft silhouette is 1, so the factor ``R_S`` of eq. 1 is exact, and
    an empty texture beyond the outline is not compared with the background.

    Args:
        pixel_loss: ``(P,)`` Cauchy loss at the covered pixels, from `tracking3d.rendering.texture_losses`.
        pixels: ``(P,)`` flat indices of the covered pixels in ``(B, H, W)``, rising.
        valid: ``(B, H, W)``.
        scale: Scale of the Cauchy loss (0.25).
        seen: ``(P,)`` how far the texture at each covered pixel is known, in [0, 1]; all known if None.
        unseen_penalty: What an unknown pixel costs instead.

    Returns:
        ``(B,)``; where nothing is covered, the cost of a residual of 1.
    """
    batch, height, width = valid.shape
    firsts = torch.arange(batch + 1, device=pixels.device) * (height * width)
    lengths = torch.searchsorted(pixels, firsts).diff()  # pixels of each frame
    loss = pixel_loss
    if seen is not None:
        loss = seen * loss + (1 - seen) * unseen_penalty
    weight = valid.reshape(-1).index_select(0, pixels)
    total, count = (torch.segment_reduce(part, "sum", lengths=lengths) for part in (loss * weight, weight))
    # Were it zero, the cheapest pose would be out of sight, and the stopping rule satisfied there.
    nothing = math.log1p(1 / scale**2)
    return torch.where(count > 0, total / count.clamp_min(1.0), nothing)


def iou_loss(silhouette: Tensor, mask: Tensor, valid: Tensor) -> Tensor:
    """First term of the silhouette loss, eq. 2: one minus the soft intersection over union, ``(B,)``."""
    mask = mask * valid
    intersection = _inner(silhouette, mask)
    union = _inner(silhouette, valid) + mask.sum((1, 2)) - intersection
    return 1 - intersection / (union + _SMALL)


def distance_loss(silhouette: Tensor, distance: Tensor, valid: Tensor) -> Tensor:
    """Second term of the silhouette loss, eq. 2: mean distance of silhouette pixels to the mask, ``(B,)``."""
    return _inner(silhouette, distance * valid) / _inner(silhouette, valid).clamp_min(1.0)


def _inner(a: Tensor, b: Tensor) -> Tensor:
    """Inner product of images ``(B, H, W)`` for each frame."""
    return (a * b).sum((1, 2))


def erode(silhouette: Tensor) -> Tensor:
    """3 x 3 erosion, as the reference applies it to the soft silhouette ``(B, H, W)``."""
    # A minimum filter; with its gradient, kornia takes four to fourteen times as long: history/pages/kornia.md.
    return -functional.max_pool2d(-silhouette[:, None], 3, 1, 1)[:, 0]


def soften(mask: Tensor, distance: Tensor, sigma: float) -> Tensor:
    """The target ``(B, H, W)`` with the same soft band as the silhouette: ``exp(-sigma d^2)`` outside."""
    # The silhouette's d ends at the outline, on average half a pixel short of the mask's nearest pixel centre.
    to_outline = (distance - 1.0 / mask.shape[-1]).clamp_min(0.0)
    return torch.maximum(mask, torch.exp(-sigma * to_outline.square()) * (distance > 0))


def motion_loss(
    keyframe: Pose, current: Pose, frames: int, free_translation: float, free_rotation: float
) -> Tensor:
    """Motion regularization, eq. 3: motion a frame since the last keyframe beyond what is free.

    Args:
        keyframe: Pose of the most recent keyframe.
        current: Pose of the current frame.
        frames: Number of frames between them (the paper's sign of this difference is a slip).
        free_translation: Object units a frame (0.1).
        free_rotation: Degrees a frame (30).
    """
    translation = torch.linalg.vector_norm(current.translation - keyframe.translation) / frames
    rotation = rotation_angle(keyframe.quaternion, current.quaternion) / frames
    return functional.relu(translation - free_translation) + functional.relu(
        rotation - math.radians(free_rotation)
    )


def laplacian_loss(laplacian: Tensor, vertices: Tensor) -> Tensor:
    """Laplacian shape regularization (SoftRas): mean squared length of ``L v``."""
    return torch.sparse.mm(laplacian, vertices).square().sum(1).mean()
