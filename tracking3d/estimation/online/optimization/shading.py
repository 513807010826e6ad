"""What several views show of the same faces: normal equations in the faces' corners, the poses and the light.

A face's value in a view is its own colour, the same in all views, and what the light adds, which is linear in the
normal in the camera's axes: the lamp stays where it is while the object turns. The own colour is eliminated: it is the
robust mean over the views. Every residual then moves with all views that see the face. A texture held fixed within a
step would hold the surface where it is, and the step would be far too short. The light is fitted again for every shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.rendering import Contour, Rendering
from tracking3d.rendering.normal_equations import screen_motion

if TYPE_CHECKING:
    from tracking3d.estimation.online.optimization.kernels.shading import ContourPoints, Drawn, Sights

FloatArray = NDArray[np.float64]
_SINGLE = (
    0.5  # loss of what one view alone shows, so that the object does not turn to where nothing contradicts
)
_RIDGE = 1e-3  # on the light, as a share of the weight of all faces


@dataclass(frozen=True, eq=False)
class SharedFaces:
    """What B views show of the faces that two views or more show, C channels."""

    cost: float  # the mean Cauchy loss, of what one view alone shows too
    drawn: Drawn
    sights: Sights
    ends: NDArray[np.int64]  # (N + 1,) where the sights of each of N faces end
    light: FloatArray  # (C, 3)
    scale: float  # difference of features at which the loss is log 2


@dataclass(frozen=True, eq=False)
class OutlineResiduals:
    """Distances of the rendered outlines from the masks', N in all."""

    contour: Contour
    residual: Tensor  # (N,) pixels; slope: (N, 2) by x and y
    slope: Tensor
    weight: Tensor  # (N,) as in the matrix of their loss


def layers_of(features: Tensor, valid: Tensor) -> NDArray[np.float32]:
    """``(B, S, S, 3 C + 1)``: ``features`` ``(B, C, S, S)`` smoothed, their slopes by x and by y, and ``valid``."""
    count = features.shape[1]
    binomial = features.new_tensor([1.0, 2.0, 1.0]) / 4
    difference = features.new_tensor([-0.5, 0.0, 0.5])
    smooth = _filter(_filter(features, binomial[None], count), binomial[:, None], count)
    slopes = [_filter(smooth, difference[None], count), _filter(smooth, difference[:, None], count)]
    layers = torch.cat([smooth, *slopes, valid[:, None]], 1).permute(0, 2, 3, 1)
    return layers.contiguous().cpu().float().numpy()


def shared_faces(drawn: Rendering, layers: NDArray[np.float32], scale: float) -> SharedFaces:
    """What the views show of the same faces at the present shape and poses.

    Args:
        drawn: The rendering.
        layers: From `layers_of`.
        scale: Difference of features at which the loss is ``log 2``.
    """
    from tracking3d.estimation.online.optimization.kernels import shading

    tensors = drawn.x_cam, drawn.screen, drawn.depth, drawn.K
    arrays = shading.Drawn(*(_array(one, np.float32) for one in tensors), _array(drawn.faces, np.int64))
    most, channels = len(arrays.faces) * len(arrays.x_cam), layers.shape[3] // 3
    sights = shading.Sights(
        np.empty(most, np.int64), np.empty(most, np.int64), np.empty((most, 3)), np.empty((most, 3 * channels)),
        np.empty(most), np.empty((most, channels)), np.empty((most, channels)),
    )  # fmt: skip
    ends, totals = np.zeros(len(arrays.faces) + 1, np.int64), np.zeros(2)
    first = arrays.x_cam[0]
    radius = float(np.linalg.norm(first - first.mean(0), axis=1).max())
    ends = ends[: shading.find_sights(arrays, layers, radius, sights, ends, totals) + 1]
    sights = shading.Sights(*(one[: ends[-1]] for one in sights))
    whole, light = max(totals[0], 1e-9), np.zeros((channels, 3))
    sights.weight[:] /= whole * channels
    loss = shading.shade(sights, ends, scale, _RIDGE / channels, light)
    cost = loss + _SINGLE * (1 - totals[1] / whole) + _RIDGE * float((light**2).sum()) / (channels * scale**2)
    return SharedFaces(float(cost), arrays, sights, ends, light, scale)


def normal_equations(
    shown: SharedFaces, outlines: OutlineResiduals, factor: float, R: Tensor, t: Tensor, modes: ShapeBasis
) -> tuple[FloatArray, FloatArray]:
    """Matrix and gradient of both costs in ``3 M + 6 B + 3 C`` unknowns.

    A mode's three directions are neighbours. A pose has ``(v, w)``, see `NormalEquations`, and a channel's light three.

    Args:
        shown: At the present shape and poses.
        outlines: The same.
        factor: The weight of what is shown.
        R: ``(B, 3, 3)``; t: ``(B, 3)``.
        modes: The modes of the shape.
    """
    from tracking3d.estimation.online.optimization.kernels import shading

    points = _contour_points(outlines, shown.drawn.K, R, t)
    seen = np.zeros(len(modes.vectors), bool)
    seen[shown.drawn.faces[shown.sights.face]] = True
    seen[points.vertices] = True
    basis = _array(modes.vectors, np.float64)[seen]
    (vertices, count), channels = basis.shape, len(shown.light)
    others = 6 * len(R) + 3 * channels
    unknowns = shading.Unknowns(
        seen.cumsum() - 1,
        basis,
        np.zeros((vertices, 6 * count + 3 * (others + 1))),
        np.zeros((others, others + 1)),
    )
    R64, t64 = _array(R, np.float64), _array(t, np.float64)
    own = factor * 2 / shown.scale**2
    shading.add_faces(shown.drawn, shown.sights, shown.ends, shown.light, R64, t64, own, unknowns)
    shading.add_outlines(points, unknowns)
    sums = basis.T @ unknowns.sums
    shape = np.empty((count, 3, count, 3))
    for row, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
        part = sums[:, row * count : (row + 1) * count]
        shape[:, i, :, j], shape[:, j, :, i] = part, part.T
    mixed = sums[:, 6 * count :].reshape(3 * count, others + 1)
    rest = np.triu(unknowns.rest[:, :-1]) + np.triu(unknowns.rest[:, :-1], 1).T
    rest.reshape(-1)[(6 * len(R)) * (others + 1) :: others + 1] += own * _RIDGE / channels
    matrix = np.block([[shape.reshape(3 * count, -1), mixed[:, :-1]], [mixed[:, :-1].T, rest]])
    return matrix, np.concatenate([mixed[:, -1], unknowns.rest[:, -1]])


def _contour_points(
    outlines: OutlineResiduals, K: NDArray[np.float32], R: Tensor, t: Tensor
) -> ContourPoints:
    """The outlines' residuals with their derivatives by points and poses."""
    from tracking3d.estimation.online.optimization.kernels.shading import ContourPoints as Points

    contour = outlines.contour
    view = contour.view
    motion = screen_motion(contour.points, torch.from_numpy(K).to(t)[view], t[view])
    by_pose = torch.einsum("ni,nia->na", outlines.slope, motion)
    by_point = torch.einsum("na,nab->nb", by_pose[:, :3], R[view])
    parts = contour.share, by_point, by_pose, outlines.residual, outlines.weight
    return Points(
        _array(view, np.int64),
        _array(contour.vertices, np.int64),
        *(_array(part, np.float64) for part in parts),
    )


def _array(tensor: Tensor, kind: type[np.generic]) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), kind)


def _filter(images: Tensor, kernel: Tensor, count: int) -> Tensor:
    """Each of the ``count`` channels correlated with a small kernel, the border repeated."""
    rows, columns = kernel.shape
    border = (columns // 2, columns // 2, rows // 2, rows // 2)
    padded = functional.pad(images, border, mode="replicate")
    return functional.conv2d(padded, kernel.expand(count, 1, rows, columns), groups=count)
