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

if TYPE_CHECKING:
    from tracking3d.estimation.online.optimization.kernels.shading import Sights

FloatArray = NDArray[np.float64]
_SINGLE = (
    0.5  # loss of what one view alone shows, so that the object does not turn to where nothing contradicts
)
_RIDGE = 1e-3  # on the light, as a share of the weight of all faces


@dataclass(frozen=True, eq=False)
class SharedFaces:
    """What B views show of the faces that two views or more show, C channels."""

    cost: float  # the mean Cauchy loss, of what one view alone shows too
    drawn: tuple[NDArray[Any], ...]  # x_cam, screen, depth, K and faces of the rendering
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
    x_cam, *rest = (_array(one, np.float32) for one in tensors)
    faces = _array(drawn.faces, np.int64)
    arrays = x_cam, *rest, faces
    most, channels = len(faces) * len(x_cam), layers.shape[3] // 3
    sights = shading.Sights(
        np.empty(most, np.int64), np.empty(most, np.int64), np.empty((most, 3)), np.empty((most, 3 * channels)),
        np.empty(most), np.empty((most, channels)), np.empty((most, channels)),
    )  # fmt: skip
    ends, totals = np.zeros(len(faces) + 1, np.int64), np.zeros(2)
    radius = float(np.linalg.norm(x_cam[0] - x_cam[0].mean(0), axis=1).max())
    ends = ends[: shading.find_sights(arrays, layers, radius, sights, ends, totals) + 1]
    sights = shading.Sights._make(one[: ends[-1]] for one in sights)
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

    (_, _, _, K, faces), contour = shown.drawn, outlines.contour
    vertices = _array(contour.vertices, np.int64)
    seen = np.zeros(len(modes.vectors), bool)
    seen[faces[shown.sights.face]] = True
    seen[vertices] = True
    basis = _array(modes.vectors, np.float64)[seen]
    count, channels, poses = basis.shape[1], len(shown.light), 6 * len(R)
    others, own = poses + 3 * channels, factor * 2 / shown.scale**2
    sums, rest = np.zeros((len(basis), 6 * count + 3 * (others + 1))), np.zeros((others, others + 1))
    at_vertices = seen.cumsum() - 1, basis, sums, rest
    turns, moves = _array(R, np.float64), _array(t, np.float64)
    shading.add_faces(shown.drawn, shown.sights, shown.ends, shown.light, turns, moves, own, at_vertices)
    residuals = torch.stack([outlines.residual, outlines.weight], 1)
    parts = (_array(one, np.float64) for one in (contour.share, contour.points, outlines.slope, residuals))
    shading.add_outlines(_array(contour.view, np.int64), vertices, *parts, K, turns, moves, at_vertices)
    rest.reshape(-1)[poses * (others + 1) + poses :: others + 2] += own * _RIDGE / channels
    sums = basis.T @ sums
    mixed = sums[:, 6 * count :].reshape(3 * count, others + 1)
    matrix = np.empty((3 * count + others, 3 * count + others))
    for row, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
        part = sums[:, row * count : (row + 1) * count]
        matrix[i : 3 * count : 3, j : 3 * count : 3] = part
        matrix[j : 3 * count : 3, i : 3 * count : 3] = part.T
    matrix[: 3 * count, 3 * count :], matrix[3 * count :, : 3 * count] = mixed[:, :-1], mixed[:, :-1].T
    matrix[3 * count :, 3 * count :] = np.triu(rest[:, :-1]) + np.triu(rest[:, :-1], 1).T
    return matrix, np.concatenate([mixed[:, -1], rest[:, -1]])


def _array(tensor: Tensor, kind: type[np.generic]) -> NDArray[Any]:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), kind)


def _filter(images: Tensor, kernel: Tensor, count: int) -> Tensor:
    """Each of the ``count`` channels correlated with a small kernel, the border repeated."""
    rows, columns = kernel.shape
    border = (columns // 2, columns // 2, rows // 2, rows // 2)
    padded = functional.pad(images, border, mode="replicate")
    return functional.conv2d(padded, kernel.expand(count, 1, rows, columns), groups=count)
