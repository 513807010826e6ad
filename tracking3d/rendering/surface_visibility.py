"""Which vertices and texels of a rendered mesh are seen in each frame.

A surface point is seen if it lies in the window, on a face that is seen from its front, and not behind what is
drawn around it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tracking3d.geometry.camera import NEAR
from tracking3d.rendering.backprojection import TexelMap
from tracking3d.rendering.renderer import Rendering, to_screen

DEPTH_TOLERANCE = 0.01
"""How far behind the drawn surface a point may lie and still be seen, in radii of the object."""


@torch.no_grad()
def visible_vertices(drawn: Rendering) -> Tensor:
    """``(B, V)`` bool: the vertices that are seen; one front face at a vertex suffices."""
    front = front_faces(drawn.screen, drawn.faces)
    corners = drawn.faces.reshape(-1).expand(len(front), -1)
    facing = torch.zeros(drawn.screen.shape[:2], dtype=torch.bool, device=front.device)
    facing = facing.scatter_reduce(1, corners, front.repeat_interleave(3, 1), "amax")
    return facing & _unhidden(drawn, drawn.x_cam)


@torch.no_grad()
def visible_texels(drawn: Rendering, texels: TexelMap) -> Tensor:
    """``(B, N)`` bool: the texels of the atlas that are seen, in the order of ``texels.texel``."""
    corners = drawn.x_cam[:, drawn.faces[texels.face]]  # (B, N, 3, 3)
    points = (corners * texels.barycentric[..., None]).sum(2)
    front = front_faces(drawn.screen, drawn.faces).index_select(1, texels.face)
    return front & _unhidden(drawn, points)


def front_faces(screen: Tensor, faces: Tensor) -> Tensor:
    """``(B, F)`` bool: the faces that turn their front to the camera, from ``(B, V, 2)`` pixels."""
    a, b, c = (screen.index_select(1, corner) for corner in faces.unbind(1))
    ab, ac = b - a, c - a
    return ab[..., 1] * ac[..., 0] > ab[..., 0] * ac[..., 1]


def deepest_around(depth: Tensor, pixel: Tensor) -> Tensor:
    """``(B, N)`` largest depth at the four pixel centres around each point; -inf off the window.

    On a plane a point's own depth lies between those four, however steep the plane is; with the nearest pixel
    alone, points of steep surfaces would seem hidden by the surface they are on.

    Args:
        depth: ``(B, H, W)`` as drawn.
        pixel: ``(B, N, 2)`` points in pixels; NaN is off the window.
    """
    _, height, width = depth.shape
    inside = (pixel > -0.5).all(2) & (pixel < pixel.new_tensor([width - 0.5, height - 0.5])).all(2)
    low = torch.where(inside[..., None], pixel, 0.0).floor().long()
    x = [(low[..., 0] + step).clamp(0, width - 1) for step in (0, 1)]
    y = [(low[..., 1] + step).clamp(0, height - 1) for step in (0, 1)]
    flat = depth.flatten(1)
    around = torch.stack([flat.gather(1, row * width + column) for row in y for column in x])
    return torch.where(inside, around.amax(0), -torch.inf)


def _unhidden(drawn: Rendering, points: Tensor) -> Tensor:
    """``(B, N)``: points ``(B, N, 3)`` in camera coordinates that lie in the window and behind nothing."""
    around = deepest_around(drawn.depth, to_screen(points, drawn.K))
    centre = drawn.x_cam.mean(1, keepdim=True)
    radius = (drawn.x_cam - centre).norm(dim=2).amax(1, keepdim=True)
    depth = points[..., 2]
    return (depth > NEAR) & (depth < around + DEPTH_TOLERANCE * radius)
