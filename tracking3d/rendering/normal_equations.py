"""Gauss-Newton for poses: the appearance loss's normal equations, and how they turn into steps.

A pose moves by a translation and a rotation in the camera's axes, ``x_cam -> exp(w) (x_cam - pivot) + pivot + v``.
At a fixed pixel the rendered texture then changes by minus its image gradient times the motion of the surface point
on the screen. The Jacobian of a pixel is never stored: what a pixel adds to the 6 x 6 matrix is a 2 x 2 matrix,
the sum over the channels, between twice the Jacobian of the projection.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.interpolation import barycentrics
from tracking3d.rendering.renderer import Rendering
from tracking3d.rendering.surface import bilinear_taps, check_shapes
from tracking3d.rendering.texture_losses import cauchy
from tracking3d.rendering.visibility import gather


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """A quadratic model ``cost + gradient d + d matrix d / 2`` in ``d = (v, w)``, for each of B frames.

    The matrix is Gauss-Newton's, with the robust loss as weights (iteratively reweighted least squares). Models of
    the same poses add up.
    """

    matrix: Tensor  # (B, 6, 6)
    gradient: Tensor  # (B, 6)
    cost: Tensor  # (B,)

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """The model of both costs together."""
        return NormalEquations(
            self.matrix + other.matrix, self.gradient + other.gradient, self.cost + other.cost
        )

    def __mul__(self, weight: float | Tensor) -> NormalEquations:
        """The model of ``weight`` times the cost; one weight, or ``(B,)`` of them."""
        each = torch.as_tensor(weight).to(self.cost).expand_as(self.cost)
        return NormalEquations(
            each[:, None, None] * self.matrix, each[:, None] * self.gradient, each * self.cost
        )

    def step(self, damping: float | Tensor = 0.0) -> Tensor:
        """``(B, 6)`` step (v, w) to the model's minimum; zero if there is none.

        Args:
            damping: Levenberg-Marquardt's: added to the diagonal, as a share of each entry; one, or ``(B,)`` of them.
        """
        damping = torch.as_tensor(damping).to(self.cost).expand_as(self.cost)[:, None]
        diagonal = self.matrix.diagonal(dim1=1, dim2=2)
        floor = 1e-9 * diagonal.amax(1, keepdim=True) + torch.finfo(diagonal.dtype).tiny
        damped = self.matrix + torch.diag_embed(damping * diagonal + floor)
        step, failed = torch.linalg.solve_ex(damped, -self.gradient)
        sound = (failed == 0) & step.isfinite().all(1)
        return torch.where(sound[:, None], step, 0.0)


@torch.no_grad()
def pose_normal_equations(
    drawn: Rendering,
    observed: Tensor,
    pivot: Tensor,
    scale: float,
    weight: Tensor | None = None,
    backend: str | None = None,
) -> NormalEquations:
    """Normal equations of the appearance loss: of each frame's mean Cauchy loss over its covered pixels.

    Args:
        drawn: The rendering at the present poses.
        observed: ``(B, C, H, W)`` features of the frames.
        pivot: ``(B, 3)`` what rotations turn about, in camera coordinates; the translation of ``T_cam_obj`` for
            the object's origin.
        scale: Residual at which the loss is ``log 2``.
        weight: ``(P,)`` how much each covered pixel counts; all the same if None.
        backend: See `tracking3d.rendering.backend`; the rendering's if None.

    Raises:
        ValueError: If a shape does not fit.
    """
    check_shapes(
        observed=(observed, "B C H W"),
        face_index=(drawn.face_index, "B H W"),
        pivot=(pivot, "B 3"),
        texture=(drawn.texture, "C T T"),
        pixels=(drawn.pixels, "P"),
        weight=(drawn.pixels if weight is None else weight, "P"),
    )
    if weight is None:
        weight = torch.ones_like(drawn.uv[:, 0])
    observed = observed.permute(0, 2, 3, 1)
    if use_numba(backend or drawn.backend, drawn.texture, drawn.screen, observed, weight):
        from tracking3d.rendering.kernels.normal_equations import equations_of_pixels

        return NormalEquations(*equations_of_pixels(drawn, observed, pivot, scale, weight))
    batch, height, width = drawn.face_index.shape
    view = torch.div(drawn.pixels, height * width, rounding_mode="floor")
    uv_by_x, uv_by_y, depth = _surface_at_pixels(drawn, view)
    value, by_u, by_v = bilinear_taps(drawn.texture, drawn.uv)
    target = observed.reshape(-1, observed.shape[3]).index_select(0, drawn.pixels)
    residual = value - target
    # Slopes of the rendered image by x and y, (2, P, C); the Jacobian has the opposite sign.
    slopes = torch.stack([uv[:, :1] * by_u + uv[:, 1:] * by_v for uv in (uv_by_x, uv_by_y)])
    total = weight.new_zeros(batch).index_add(0, view, weight).clamp_min(1.0)
    share = (weight / total.index_select(0, view)) / residual.shape[1]
    robust = 2 / (scale**2 + residual.square())
    inner = torch.einsum("ipc,pc,jpc,p->pij", slopes, robust, slopes, share)
    pull = torch.einsum("ipc,pc,pc,p->pi", slopes, robust, residual, share)
    motion = screen_motion(_unproject(drawn, view, depth), drawn.K[view], pivot[view])  # (P, 2, 6)
    matrix = torch.einsum("pia,pij,pjb->pab", motion, inner, motion)
    gradient = -torch.einsum("pia,pi->pa", motion, pull)
    cost = share * cauchy(value, target, scale).sum(1)
    return NormalEquations(
        *(
            part.new_zeros(batch, *part.shape[1:]).index_add(0, view, part)
            for part in (matrix, gradient, cost)
        )
    )


def screen_motion(points: Tensor, K: Tensor, pivot: Tensor) -> Tensor:
    """``(N, 2, 6)`` motion in pixels of surface points by (v, w).

    Args:
        points: ``(N, 3)`` in camera coordinates.
        K: ``(N, 3, 3)``; pivot: ``(N, 3)``.
    """
    x, y, z = points.unbind(1)
    zero = torch.zeros_like(z)
    fx, fy = K[:, 0, 0] / z, K[:, 1, 1] / z
    by_point = torch.stack([fx, zero, -fx * x / z, zero, fy, -fy * y / z], 1).reshape(-1, 2, 3)
    ax, ay, az = (points - pivot).unbind(1)
    # w x a is minus the cross product matrix of a times w.
    by_rotation = torch.stack([zero, az, -ay, -az, zero, ax, ay, -ax, zero], 1).reshape(-1, 3, 3)
    return torch.cat([by_point, by_point @ by_rotation], 2)


def _surface_at_pixels(drawn: Rendering, view: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Slopes of the texture coordinates by x and by y, ``(P, 2)`` each, and depths ``(P,)``, at covered pixels."""
    _, height, width = drawn.face_index.shape
    face = gather(drawn.face_index, drawn.pixels)
    vertex = drawn.faces.T.contiguous().index_select(1, face) + view * drawn.screen.shape[1]
    row = torch.div(drawn.pixels, width, rounding_mode="floor")
    x, y = (drawn.pixels - row * width).to(drawn.screen), (row - view * height).to(drawn.screen)
    corner_x, corner_y = (gather(plane, vertex) for plane in drawn.screen.unbind(2))
    w, by_x, by_y = barycentrics(corner_x, corner_y, x, y)
    inverse = 1 / gather(drawn.x_cam[..., 2], vertex)
    depth = 1 / (w * inverse).sum(0)
    away = drawn.face_uvs.index_select(0, face).permute(1, 0, 2) - drawn.uv  # (3, P, 2)
    uv_by_x, uv_by_y = (((slope * inverse * depth)[..., None] * away).sum(0) for slope in (by_x, by_y))
    return uv_by_x, uv_by_y, depth


def _unproject(drawn: Rendering, view: Tensor, depth: Tensor) -> Tensor:
    """``(P, 3)`` surface points at the covered pixels in camera coordinates."""
    _, height, width = drawn.face_index.shape
    row = torch.div(drawn.pixels, width, rounding_mode="floor")
    pixel = torch.stack([drawn.pixels - row * width, row - view * height], 1).to(depth)
    K = drawn.K.index_select(0, view)
    ray = (pixel - K[:, :2, 2]) / torch.stack([K[:, 0, 0], K[:, 1, 1]], 1)
    return torch.cat([ray, torch.ones_like(ray[:, :1])], 1) * depth[:, None]
