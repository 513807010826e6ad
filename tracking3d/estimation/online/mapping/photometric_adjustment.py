"""Joint adjustment of shape and poses of some views, for objects without points.

Levenberg-Marquardt on the photometric differences of shared faces (`face_equations`), on the outlines' signed
distances, and on the Laplacian of the shape's offsets. The shape moves in the lowest modes of its Laplacian, so that
all unknowns form one small dense system. The first pose is fixed. If the map has a free axis, its surface stays one of
revolution: the shape moves by its profile, and the axis is fixed in place of the first pose.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tracking3d.estimation.online.optimization.shading import (
    SharedFaces,
    face_equations,
    layers_of,
    shared_faces,
)
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis, project_on_basis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.shape import flatten, unfold
from tracking3d.geometry.pose import Pose, from_matrix, rotation_exponential
from tracking3d.rendering import Contour, Rendering, find_contour, render
from tracking3d.rendering.contour import contour_slopes
from tracking3d.rendering.normal_equations import screen_motion

_APPEARANCE = 4.0  # weight of the mean photometric loss
_APPEARANCE_SCALE = 0.25
_FULL_SIZE = 128.0  # pixels of a window in which outline distances are measured, whatever its resolution
_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-5, 1e3
_DAMPING_DECREASE, _DAMPING_INCREASE = (
    2.0,
    4.0,
)  # factors of the damping after a successful step and after a rejected one
_MIN_GAIN = 1e-4  # share of the cost below which a gain is small
_MAX_SMALL_GAINS = 3  # in a row end the search; a single one often means only that the damping was too high


@dataclass(frozen=True, eq=False)
class _Problem:
    """The constants of one fit."""

    object_map: ObjectMap  # the map that is fitted; modes, weights: As given
    modes: ShapeBasis
    weights: FitWeights
    K: Tensor  # (B, 3, 3) of the windows
    layers: Tensor  # see `layers_of`
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
        channels = (self.layers.shape[1] - 1) // 3
        return self.shape_unknowns + 6 * len(self.K) + 3 * channels


@dataclass(frozen=True, eq=False)
class _Outlines:
    """The rendered outlines: distances from the masks' in pixels, gradients, weights, and the cost."""

    contour: Contour
    residual: Tensor
    slope: Tensor
    weight: Tensor
    cost: float


@dataclass(frozen=True, eq=False)
class _State:
    """Vertices and poses, their rendering, and its cost."""

    vertices: Tensor
    poses: Pose
    faces: SharedFaces
    outlines: _Outlines
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
    free = torch.ones(problem.unknowns, dtype=torch.bool)
    if axis is None:
        free[problem.shape_unknowns : problem.shape_unknowns + 6] = False  # the first pose
    state = _minimize(problem, free, iterations)
    keyframes = tuple(
        replace(view, pose=state.poses[n], texture=None) for n, view in enumerate(object_map.keyframes)
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
        torch.stack([o.outline_distance for o in observations]),
        torch.tensor(believed).to(object_map.vertices),
    )


def _minimize(problem: _Problem, free: Tensor, iterations: int) -> _State:
    """The best state that Levenberg-Marquardt reaches in the free unknowns."""
    poses = Pose.stack([view.pose for view in problem.object_map.keyframes])
    state = _evaluate(problem, problem.object_map.vertices, poses)
    equations: _Equations | None = None
    damping, small = _DAMPING, 0
    for _ in range(iterations):
        equations = equations or _linearize(problem, state)
        trial = _step(problem, state, equations, free, damping)
        if trial is not None and trial.cost < state.cost:
            gain = state.cost - trial.cost
            state, equations, damping = trial, None, max(damping / _DAMPING_DECREASE, _LEAST_DAMPING)
            small = small + 1 if gain < _MIN_GAIN * state.cost else 0
            if small == _MAX_SMALL_GAINS:
                break
        else:
            damping *= _DAMPING_INCREASE
            if damping > _MOST_DAMPING:
                break
    return state


def _step(
    problem: _Problem, state: _State, equations: _Equations, free: Tensor, damping: float
) -> _State | None:
    """The state after one step; None if there is none."""
    # The light is fitted again at every state: its part of the step is only what the others must allow for.
    free = free.clone()
    free[problem.shape_unknowns + 6 * len(problem.K) :] = True
    matrix, gradient = equations.matrix, equations.gradient
    if problem.tied is not None:
        tied = torch.block_diag(problem.tied, torch.eye(len(free) - len(problem.tied)).to(problem.tied))
        matrix, gradient, free = tied.T @ matrix @ tied, tied.T @ gradient, (free[:, None] * tied != 0).any(0)
    matrix = matrix[free][:, free]
    diagonal = matrix.diagonal()
    damped = matrix + torch.diag(damping * diagonal + 1e-7 * diagonal.max())
    solution, failed = torch.linalg.solve_ex(damped, -gradient[free])
    if failed or not solution.isfinite().all():
        return None
    step = torch.zeros_like(gradient)
    step[free] = solution
    step = step if problem.tied is None else tied @ step
    shape, poses, _ = step.split(
        [problem.shape_unknowns, 6 * len(problem.K), len(step) - problem.shape_unknowns - 6 * len(problem.K)]
    )
    vertices = state.vertices + (problem.modes.vectors @ shape.reshape(-1, 3)).to(state.vertices)
    vertices = vertices if problem.tied is not None else unfold(problem.object_map.shape, vertices)
    # Steps (v, w) in the camera's axes, about the poses' own translations.
    moving, turning = poses.reshape(-1, 6).to(vertices).split(3, dim=1)
    moved = from_matrix(rotation_exponential(turning) @ state.poses.R, state.poses.translation + moving)
    return _evaluate(problem, vertices, moved)


def _evaluate(problem: _Problem, vertices: Tensor, poses: Pose) -> _State:
    """The rendering of vertices and poses, and its cost."""
    object_map = problem.object_map
    drawn = render(
        vertices, object_map.shape.faces, object_map.shape.face_uvs, vertices.new_zeros(1, 8, 8), poses.R,
        poses.translation, problem.K, (problem.size, problem.size), backend=object_map.renderer,
    )  # fmt: skip
    faces, outlines = shared_faces(drawn, problem.layers, _APPEARANCE_SCALE), _outlines(problem, drawn)
    stiffness, offsets = _bending(problem, vertices)
    cost = _APPEARANCE * faces.cost + outlines.cost + float((stiffness * offsets.square()).sum())
    return _State(vertices, poses, faces, outlines, cost)


def _linearize(problem: _Problem, state: _State) -> _Equations:
    """Normal equations in the modes, the poses and the light."""
    modes, R, t = problem.modes, state.poses.R, state.poses.translation
    by_faces = face_equations(state.faces, R, t)
    matrix, gradient = project_on_basis(by_faces, modes, problem.object_map.shape.faces)
    matrix, gradient = _APPEARANCE * matrix, _APPEARANCE * gradient
    jacobian, weighted = _outline_rows(problem, state.outlines, R, t)
    count = jacobian.shape[1]
    matrix[:count, :count] += (jacobian.T @ weighted).double()
    gradient[:count] += (weighted.T @ state.outlines.residual).double()
    stiffness, offsets = _bending(problem, state.vertices)
    count = 3 * len(modes.bending)
    gradient[:count] += 2 * (stiffness * offsets).reshape(-1)
    matrix.diagonal()[:count] += 2 * stiffness.expand(-1, 3).reshape(-1)
    return _Equations(matrix, gradient)


def _bending(problem: _Problem, vertices: Tensor) -> tuple[Tensor, Tensor]:
    """The bending energy of each mode ``(M, 1)``, and the shape's coefficient in it ``(M, 3)``."""
    modes = problem.modes
    stiffness = problem.weights.smoothness / len(vertices) * modes.bending[:, None]
    return stiffness, modes.vectors.T @ (vertices - problem.object_map.shape.rest).double()


def _outlines(problem: _Problem, drawn: Rendering) -> _Outlines:
    weights, contour = problem.weights, find_contour(drawn)
    view = contour.view
    scale = _FULL_SIZE / problem.size
    residual, slope = (part * scale for part in contour_slopes(contour, problem.distance))
    total = residual.new_zeros(contour.frames).index_add(0, view, contour.length).clamp_min(1.0)
    weight = weights.outline * contour.length / total[view] / contour.frames * problem.mask_weight[view]
    square = weights.outline_scale**2
    cost = float((weight * square * torch.log1p(residual.square() / square)).sum())
    return _Outlines(contour, residual, slope, weight, cost)


def _outline_rows(problem: _Problem, outlines: _Outlines, R: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """The outlines' Jacobian in modes and poses ``(N, 3 M + 6 B)``, and the same by its robust weights."""
    contour, residual, slope = outlines.contour, outlines.residual, outlines.slope
    view, vectors = contour.view, problem.modes.vectors
    motion = screen_motion(contour.points, problem.K[view], t[view])
    by_pose = torch.einsum("ni,nia->na", slope, motion)
    by_object = torch.einsum("na,nab->nb", by_pose[:, :3], R[view])
    mode = (contour.share[:, :, None] * vectors.to(slope)[contour.vertices]).sum(1)
    by_mode = (mode[:, :, None] * by_object[:, None]).flatten(1)
    by_poses = by_pose.new_zeros(len(view), contour.frames, 6)
    by_poses[torch.arange(len(view)), view] = by_pose
    jacobian = torch.cat([by_mode, by_poses.flatten(1)], 1)
    square = problem.weights.outline_scale**2
    return jacobian, jacobian * (2 * outlines.weight / (1 + residual.square() / square))[:, None]
