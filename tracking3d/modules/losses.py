"""The losses that shapes, textures and poses are fitted by, as modules; what kornia has is not here.

Each gives one number, or with ``reduction="none"`` one for each of B frames.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from tracking3d.estimation.paper.problem import iou_loss, laplacian_loss
from tracking3d.geometry.mesh import uniform_laplacian
from tracking3d.modules.renderer import RenderedViews
from tracking3d.rendering import contour_loss, find_contour, signed_distance, texture_losses
from tracking3d.rendering.surface import check_shapes

Reduction = Literal["mean", "none"]


class _PerFrame(nn.Module):
    def __init__(self, reduction: Reduction = "mean") -> None:
        super().__init__()
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction is {reduction!r}; give 'mean' or 'none'")
        self.reduction = reduction

    def _reduce(self, loss: Tensor) -> Tensor:
        return loss.mean() if self.reduction == "mean" else loss


class SilhouetteLoss(_PerFrame):
    """One minus the soft intersection over union (the paper's eq. 2, first term)."""

    def forward(self, silhouette: Tensor, mask: Tensor, valid: Tensor | None = None) -> Tensor:
        """Compare silhouettes with masks.

        Args:
            silhouette: ``(B, 1, H, W)`` in [0, 1].
            mask: ``(B, 1, H, W)`` in [0, 1].
            valid: ``(B, 1, H, W)``, 0 where nothing is known of the frame; 1 everywhere if None.

        Raises:
            ValueError: If a shape does not fit.
        """
        valid = torch.ones_like(mask) if valid is None else valid
        check_shapes(
            silhouette=(silhouette, "B 1 H W"), mask=(mask, "B 1 H W"), valid=(valid, "B 1 H W")
        )  # fmt: skip
        return self._reduce(iou_loss(silhouette[:, 0], mask[:, 0], valid[:, 0]))


class OutlineLoss(_PerFrame):
    """Cauchy loss of the distance between the mesh's outline and the mask's; unlike a silhouette it pulls from afar.

    Args:
        scale: Pixels at which it is ``log 2``.
        reduction: ``mean`` or ``none``.
    """

    def __init__(self, scale: float = 2.0, reduction: Reduction = "mean") -> None:
        super().__init__(reduction)
        self.scale = scale

    def forward(self, views: RenderedViews, mask: Tensor) -> Tensor:
        """Compare outlines; differentiable in where the outline's points are, their number and weights held fixed.

        Args:
            views: Views of `MeshRenderer`.
            mask: ``(B, 1, H, W)`` in [0, 1].

        Raises:
            ValueError: If a shape does not fit.
        """
        check_shapes(mask=(mask, f"{len(views.image)} 1 H W"))
        distance = signed_distance(mask[:, 0])
        return self._reduce(contour_loss(find_contour(views.drawn), distance, self.scale))


class TextureLoss(nn.Module):
    """Cauchy loss between a texture and what frames show, and the texture's own roughness, in one operation.

    It looks at covered pixels only, and needs no tensor of pixels times channels; kornia's ``CauchyLoss`` of two images
    is what it stands for.

    Args:
        scale: Residual at which a loss is ``log 2``.
        roughness: Weight of the total variation.
    """

    def __init__(self, scale: float = 0.25, roughness: float = 0.0) -> None:
        super().__init__()
        self.scale, self.roughness = scale, roughness

    def forward(self, views: RenderedViews, observed: Tensor) -> Tensor:
        """Compare; differentiable in texture, vertices, poses and cameras.

        Args:
            views: Views of `MeshRenderer`.
            observed: ``(B, C, H, W)``.

        Raises:
            ValueError: If a shape does not fit.
        """
        drawn = views.drawn
        loss, variation = texture_losses(
            drawn.texture, drawn.uv, observed, drawn.pixels, self.scale,
            total_variation=self.roughness > 0, backend=drawn.backend,
        )  # fmt: skip
        return loss.sum() / max(len(loss), 1) + self.roughness * variation


class LaplacianLoss(nn.Module):
    """Mean squared distance of the vertices from the middle of their neighbours (SoftRas): it keeps a shape smooth.

    Args:
        faces: ``(F, 3)`` int64.
        vertices: How many there are.
    """

    laplacian: Tensor

    def __init__(self, faces: Tensor, vertices: int) -> None:
        super().__init__()
        self.register_buffer("laplacian", uniform_laplacian(faces, vertices))

    def forward(self, vertices: Tensor) -> Tensor:
        """The loss of ``(V, 3)`` vertices."""
        return laplacian_loss(self.laplacian.to(vertices.dtype), vertices)
