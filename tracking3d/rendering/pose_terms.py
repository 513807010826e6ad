"""What one frame says of poses: the terms of a pose's cost and their normal equations, many poses at once.

There are three terms, each a mean of Cauchy losses: of the features at the covered pixels, of the silhouette's
distance to the mask's outline, and of the distances between projected points and where the frame shows them. The
torch implementation puts together what `tracking3d.rendering` offers one by one; the kernel does the same in one pass
and keeps nothing that is not asked for.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.contour import contour_normal_equations, find_contour
from tracking3d.rendering.normal_equations import NormalEquations, pose_normal_equations, screen_motion
from tracking3d.rendering.pose_comparison import (
    NEAREST_POINT,
    MatchedPoints,
    PoseTarget,
    PoseTerms,
    Scales,
    check_comparison,
)
from tracking3d.rendering.renderer import render
from tracking3d.rendering.surface import Surface, check_shapes, sample_texture


@torch.no_grad()
def pose_terms(
    surface: Surface, target: PoseTarget, R: Tensor, t: Tensor, matched: MatchedPoints | None, scales: Scales
) -> PoseTerms:
    """The terms at poses of one frame; steps turn about each pose's translation.

    Args:
        surface: The object.
        target: The frame.
        R: ``(B, 3, 3)``; t: ``(B, 3)``: rotations and translations of ``T_cam_obj``.
        matched: Points with known places in the window, or None.
        scales: Scales of the losses.

    Raises:
        ValueError: If a shape does not fit. If the surface's renderer cannot render these tensors.
    """
    check_shapes(R=(R, "B 3 3"), t=(t, "B 3"))
    check_comparison(surface, target, matched)
    if use_numba(surface.renderer, surface.vertices, surface.texture, target.features, R, t):
        from tracking3d.rendering.kernels.pose_terms import pose_terms as by_kernel

        return by_kernel(surface, target, R, t, matched, scales, NEAREST_POINT)
    return _compose(surface, target, R, t, matched, scales)


def _compose(
    surface: Surface, target: PoseTarget, R: Tensor, t: Tensor, matched: MatchedPoints | None, scales: Scales
) -> PoseTerms:
    """By the renderer and what is known of its derivatives."""
    count, size = len(R), target.features.shape[-2:]
    drawn = render(
        surface.vertices, surface.faces, surface.face_uvs, surface.texture, R, t, target.K.expand(count, 3, 3),
        (size[0], size[1]), backend=surface.renderer,
    )  # fmt: skip
    view = torch.div(drawn.pixels, target.comparable.numel(), rounding_mode="floor")
    comparable = target.comparable.flatten()[drawn.pixels - view * target.comparable.numel()]
    known = sample_texture(surface.seen, drawn.uv)[:, 0] * comparable
    zero = t.new_zeros(count)
    nothing = NormalEquations(t.new_zeros(count, 6, 6), t.new_zeros(count, 6), zero)
    appearance = pose_normal_equations(
        drawn, target.features.expand(count, *target.features.shape), t, scales.appearance, known
    )
    outline = points = nothing
    if target.distance is not None:
        distance = target.distance.expand(count, *target.distance.shape)
        outline = contour_normal_equations(drawn, find_contour(drawn), distance, t, scales.outline)
    if matched is not None and len(matched):
        points = _points(matched, target.K, R, t, scales.points)
    return PoseTerms(
        _on_host(appearance),
        _on_host(outline),
        _on_host(points),
        zero.index_add(0, view, comparable).double().cpu(),
        zero.index_add(0, view, known).double().cpu(),
        target.overlap(drawn.face_index >= 0),
    )


def _on_host(model: NormalEquations) -> NormalEquations:
    return NormalEquations(*(part.double().cpu() for part in (model.matrix, model.gradient, model.cost)))


def _points(matched: MatchedPoints, K: Tensor, R: Tensor, t: Tensor, scale: float) -> NormalEquations:
    """Normal equations of the mean Cauchy loss of the distances between projected points and pixels."""
    poses, count = len(R), len(matched)
    x_cam = matched.points @ R.mT + t[:, None]
    x_cam = torch.cat([x_cam[..., :2], x_cam[..., 2:].clamp_min(NEAREST_POINT)], 2)
    projected = x_cam[..., :2] / x_cam[..., 2:] * K.diagonal()[:2] + K[:2, 2]
    residual = projected - matched.pixels
    squared = residual.square().sum(2)
    motion = screen_motion(
        x_cam.flatten(0, 1), K.expand(poses * count, 3, 3), t.repeat_interleave(count, 0)
    ).reshape(poses, count, 2, 6)
    weight = 2 / (scale**2 + squared) / count
    return NormalEquations(
        torch.einsum("bnia,bn,bnic->bac", motion, weight, motion),
        torch.einsum("bnia,bn,bni->ba", motion, weight, residual),
        torch.log1p(squared / scale**2).mean(1),
    )
