"""Joint adjustment of shape and poses of some views, for objects without points.

Levenberg-Marquardt on the photometric differences of shared faces (`normal_equations`), on the outlines' signed
distances, and on the Laplacian of the shape's offsets. The shape moves in the lowest modes of its Laplacian, so that
all unknowns form one small dense system. The first pose is fixed. If the map has a free axis, its surface stays one of
revolution: the shape moves by its profile, and the axis is fixed in place of the first pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.online.optimization.shading import (
    OutlineResiduals,
    SharedFaces,
    layers_of,
    normal_equations,
    shared_faces,
)
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.shape import flatten, unfold
from tracking3d.geometry.levenberg_marquardt import Damping, minimizer
from tracking3d.geometry.pose import Pose, from_matrix, rotation_exponential
from tracking3d.rendering import Rendering, find_contour, render
from tracking3d.rendering.contour import contour_slopes
from tracking3d.rendering.surface import edges_of

_APPEARANCE = 4.0  # weight of the mean photometric loss
_APPEARANCE_SCALE = 0.25
_FULL_SIZE = 128.0  # pixels of a window in which outline distances are measured, whatever its resolution
# A single small gain often means only that the damping was too high
_DAMPING = Damping(first=1e-2, least=1e-5, decrease=2, increase=4, small_gains=3)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The constants of one fit."""

    object_map: ObjectMap  # the map that is fitted; modes, weights: As given
    modes: ShapeBasis
    weights: FitWeights
    K: Tensor  # (B, 3, 3) of the windows
    layers: NDArray[np.float32]  # see `layers_of`
    edges: tuple[Tensor, Tensor]  # of the faces, see `edges_of`
    distance: Tensor  # (B, S, S) to the masks' outlines, pixels of the window
    mask_weight: Tensor  # (B,) how far each mask is trusted
    # (3 M, N) the shape unknowns for each change of the profile of a surface of revolution; None: all are free
    tied: Tensor | None = None

    @property
    def size(self) -> int:
        """Side of the windows."""
        return int(self.distance.shape[1])

    @property
    def shape_unknowns(self) -> int:
        """The number of shape unknowns; six for each pose and three for each channel's light follow."""
        return 3 * len(self.modes.bending)

    @property
    def unknowns(self) -> int:
        """The number of all unknowns."""
        return self.shape_unknowns + 6 * len(self.K) + self.layers.shape[3] - 1


@dataclass(frozen=True, eq=False)
class _State:
    """Vertices and poses, their rendering, and its cost."""

    vertices: Tensor
    R: Tensor  # (B, 3, 3); t: (B, 3)
    t: Tensor
    faces: SharedFaces
    outlines: OutlineResiduals
    stiffness: Tensor  # (M, 1) bending energy of each mode; offsets: (M, 3) the shape's coefficients
    offsets: Tensor
    cost: float


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of a state's cost in modes, poses and light."""

    matrix: Tensor
    gradient: Tensor


def fit_jointly(
    object_map: ObjectMap, modes: ShapeBasis, weights: FitWeights, iterations: int
) -> tuple[ObjectMap, float]:
    """The map with vertices and keyframe poses, except the first, that explain its keyframes better; their cost.

    Args:
        object_map: The map; its keyframes' observations may be halved. Landmarks are not used.
        modes: The basis of the shape's offsets.
        weights: The weights of outline and smoothness.
        iterations: The most evaluations after the first.
    """
    axis, tied = object_map.free_axis, None
    if axis is not None:
        modes, tied = axis.basis(object_map.vertices)
    problem = replace(_problem(object_map, modes, weights), tied=tied)
    poses = Pose.stack([view.pose for view in object_map.keyframes])
    start = _evaluate(problem, object_map.vertices, poses.R, poses.translation)
    state, _ = minimizer(_linearize, _step)(problem, start, _DAMPING, iterations)
    fitted = from_matrix(state.R, state.t)
    keyframes = tuple(
        replace(view, pose=fitted[n], texture=None) for n, view in enumerate(object_map.keyframes)
    )
    return replace(object_map, vertices=state.vertices, keyframes=keyframes), state.cost


def refine_without_points(
    object_map: ObjectMap, positions: list[int], weights: FitWeights, iterations: int = 6
) -> ObjectMap:
    """Fit shape and keyframes at ``positions`` together, from pixels and outlines alone.

    Args:
        object_map: The map.
        positions: Positions of the keyframes to refine, ascending; the first one's pose is fixed.
        weights: The weights of outline and smoothness.
        iterations: The most evaluations.
    """
    if len(positions) < 2:
        return object_map
    window = replace(object_map, keyframes=tuple(object_map.keyframes[position] for position in positions))
    fitted, _ = fit_jointly(window, ShapeBasis.of(object_map.shape), weights, iterations)
    keyframes = list(object_map.keyframes)
    for position, view in zip(positions, fitted.keyframes, strict=True):
        keyframes[position] = view
    vertices = flatten(fitted.vertices) if object_map.shape.flat else fitted.vertices
    return replace(object_map, vertices=vertices, keyframes=tuple(keyframes))


def _problem(object_map: ObjectMap, modes: ShapeBasis, weights: FitWeights) -> _Problem:
    observations = [view.observation for view in object_map.keyframes]
    valid = torch.stack([o.valid * (o.mask if o.has_mask else 1.0) for o in observations])
    believed = [view.mask_weight * view.observation.has_mask for view in object_map.keyframes]
    return _Problem(
        object_map,
        modes,
        weights,
        torch.stack([o.K for o in observations]),
        layers_of(torch.stack([o.features for o in observations]), valid),
        edges_of(object_map.shape.faces),
        torch.stack([o.outline_distance for o in observations]),
        torch.tensor(believed).to(object_map.vertices),
    )


def _step(problem: _Problem, state: _State, equations: _Equations, damping: float) -> _State:
    """The state after one step; at infinite cost if there is none."""
    # The light is fitted again at every state: its part of the step is only what the others must allow for.
    free = torch.ones(problem.unknowns, dtype=torch.bool)
    if problem.tied is None:
        free[problem.shape_unknowns : problem.shape_unknowns + 6] = False  # the first pose
    matrix, gradient = equations.matrix, equations.gradient
    if problem.tied is not None:
        tied = torch.block_diag(problem.tied, torch.eye(len(free) - len(problem.tied)).to(problem.tied))
        matrix, gradient, free = tied.T @ matrix @ tied, tied.T @ gradient, (free[:, None] * tied != 0).any(0)
    matrix = matrix[free][:, free]
    diagonal = matrix.diagonal()
    diagonal += damping * diagonal + 1e-7 * diagonal.max()
    factor, failed = torch.linalg.cholesky_ex(matrix)
    if failed:
        return replace(state, cost=math.inf)
    step = torch.zeros_like(gradient)
    step[free] = torch.cholesky_solve(-gradient[free, None], factor)[:, 0]
    step = step if problem.tied is None else tied @ step
    shape, poses, _ = step.split(
        [problem.shape_unknowns, 6 * len(problem.K), len(step) - problem.shape_unknowns - 6 * len(problem.K)]
    )
    vertices = state.vertices + (problem.modes.vectors @ shape.reshape(-1, 3)).to(state.vertices)
    vertices = vertices if problem.tied is not None else unfold(problem.object_map.shape, vertices)
    # Steps (v, w) in the camera's axes, about the poses' own translations.
    moving, turning = poses.reshape(-1, 6).to(vertices).split(3, dim=1)
    return _evaluate(problem, vertices, rotation_exponential(turning) @ state.R, state.t + moving)


def _evaluate(problem: _Problem, vertices: Tensor, R: Tensor, t: Tensor) -> _State:
    """The rendering of vertices and poses, and its cost."""
    object_map = problem.object_map
    drawn = render(
        vertices, object_map.shape.faces, object_map.shape.face_uvs, vertices.new_zeros(1, 8, 8), R, t, problem.K,
        (problem.size, problem.size), backend=object_map.renderer,
    )  # fmt: skip
    faces = shared_faces(drawn, problem.layers, _APPEARANCE_SCALE)
    outlines, outline_cost = _outlines(problem, drawn)
    stiffness, offsets = _bending(problem, vertices)
    cost = _APPEARANCE * faces.cost + outline_cost + float((stiffness * offsets.square()).sum())
    return _State(vertices, R, t, faces, outlines, stiffness, offsets, cost)


def _linearize(problem: _Problem, state: _State) -> _Equations:
    """Normal equations in the modes, the poses and the light."""
    modes, stiffness = problem.modes, state.stiffness
    equations = normal_equations(state.faces, state.outlines, _APPEARANCE, state.R, state.t, modes)
    matrix, gradient = (torch.from_numpy(one).to(modes.vectors) for one in equations)
    count = 3 * len(modes.bending)
    gradient[:count] += 2 * (stiffness * state.offsets).reshape(-1)
    matrix.diagonal()[:count] += 2 * stiffness.expand(-1, 3).reshape(-1)
    return _Equations(matrix, gradient)


def _bending(problem: _Problem, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """The bending energy of each mode ``(M, 1)``, and the shape's coefficient in it ``(M, 3)``."""
    modes = problem.modes
    stiffness = problem.weights.smoothness / len(vertices) * modes.bending[:, None]
    return stiffness, modes.vectors.T @ (vertices - problem.object_map.shape.rest).double()


def _outlines(problem: _Problem, drawn: Rendering) -> tuple[OutlineResiduals, float]:
    """The rendered outlines' distances from the masks', and their cost."""
    weights, contour = problem.weights, find_contour(drawn, problem.edges)
    view = contour.view
    scale = _FULL_SIZE / problem.size
    residual, slope = (part * scale for part in contour_slopes(contour, problem.distance))
    total = residual.new_zeros(contour.frames).index_add(0, view, contour.length).clamp_min(1.0)
    weight = weights.outline * contour.length / total[view] / contour.frames * problem.mask_weight[view]
    square = weights.outline_scale**2
    cost = float((weight * square * torch.log1p(residual.square() / square)).sum())
    return OutlineResiduals(contour, residual, slope, 2 * weight / (1 + residual.square() / square)), cost
