"""One frame's pose against a known object: Levenberg-Marquardt on pixels, outline and matched points together."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tracking3d.estimation.observation import Observation, halved
from tracking3d.geometry.pose import Pose, from_matrix, rotation_exponential
from tracking3d.rendering import (
    NormalEquations,
    Rendering,
    contour_normal_equations,
    find_contour,
    pose_normal_equations,
    render,
    sample_texture,
    signed_distance,
)
from tracking3d.rendering.normal_equations import screen_motion


@dataclass(frozen=True, eq=False)
class Surface:
    """The object as poses are fitted to it.

    Attributes:
        vertices: ``(V, 3)`` in object coordinates; faces: ``(F, 3)``; face_uvs: ``(F, 3, 2)``.
        texture: ``(C, T, T)`` features.
        seen: ``(1, T, T)`` 1 where the texture is known, else 0.
        renderer: Which renderer, see `tracking3d.rendering.backend`.
    """

    vertices: Tensor
    faces: Tensor
    face_uvs: Tensor
    texture: Tensor
    seen: Tensor
    renderer: str = "auto"


@dataclass(frozen=True, eq=False)
class MatchedPoints:
    """Surface points and where a frame shows them.

    Attributes:
        points: ``(N, 3)`` in object coordinates.
        pixels: ``(N, 2)`` in the frame's window at full working resolution.
    """

    points: Tensor
    pixels: Tensor

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class PoseWeights:
    """What each kind of evidence counts, and where its robust loss turns over."""

    appearance: float = 1.0
    appearance_scale: float = 0.25
    outline: float = 0.3
    outline_scale: float = 2.0
    points: float = 1.0
    points_scale: float = 1.0
    unseen: float = 0.5


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A pose and how well it explains the frame.

    Attributes:
        pose: Of the frame.
        cost: What was minimized.
        appearance: Mean Cauchy loss over the covered pixels, unseen ones charged.
        outline: Mean Cauchy loss of the outline; 0 without a mask.
        points: Mean Cauchy loss of the matched points; 0 without any.
        information: ``(6, 6)`` matrix of the normal equations.
        iterations: Evaluations spent.
    """

    pose: Pose
    cost: float
    appearance: float
    outline: float
    points: float
    information: Tensor
    iterations: int


@dataclass(frozen=True, eq=False)
class _Level:
    observation: Observation
    distance: Tensor | None
    pixels: Tensor | None


def refine_pose(
    surface: Surface,
    observation: Observation,
    start: Pose,
    matched: MatchedPoints | None = None,
    weights: PoseWeights = PoseWeights(),
    iterations: tuple[int, ...] = (4, 5),
) -> PoseFit:
    """Fit one pose, coarse to fine.

    Args:
        surface: The object.
        observation: The frame.
        start: Where to start.
        matched: Points with known places in the frame.
        weights: Of the kinds of evidence.
        iterations: Most steps at each resolution, the last one at full working resolution.
    """
    levels = [_Level(observation, None, matched.pixels if matched else None)]
    while len(levels) < len(iterations):
        finer = levels[0]
        pixels = None if finer.pixels is None else (finer.pixels + 0.5) / 2 - 0.5
        levels.insert(0, _Level(halved(finer.observation), None, pixels))
    fit: PoseFit | None = None
    pose, spent = start, 0
    for level, steps in zip(levels, iterations, strict=True):
        seen = level.observation
        distance = signed_distance(seen.mask[None]) if seen.has_mask else None
        scale = seen.window.size / observation.window.size
        fit = _minimize(surface, replace(level, distance=distance), pose, matched, weights, steps, scale)
        pose, spent = fit.pose, spent + fit.iterations
    assert fit is not None
    return replace(fit, iterations=spent)


def _minimize(
    surface: Surface,
    level: _Level,
    pose: Pose,
    matched: MatchedPoints | None,
    weights: PoseWeights,
    steps: int,
    scale: float,
) -> PoseFit:
    damping = 1e-3
    best = _evaluate(surface, level, pose, matched, weights, scale)
    spent = 1
    for _ in range(steps):
        model, fit = best
        step = model.step(damping)[0]
        trial = _evaluate(surface, level, moved(fit.pose, step), matched, weights, scale)
        spent += 1
        if trial[1].cost < fit.cost:
            gain = fit.cost - trial[1].cost
            best, damping = trial, max(damping / 4, 1e-6)
            if gain < 1e-4 * fit.cost:
                break
        else:
            damping *= 8
            if damping > 1e3:
                break
    return replace(best[1], iterations=spent)


def _evaluate(
    surface: Surface,
    level: _Level,
    pose: Pose,
    matched: MatchedPoints | None,
    weights: PoseWeights,
    scale: float,
) -> tuple[NormalEquations, PoseFit]:
    seen = level.observation
    R, t = pose.R[None], pose.translation[None]
    drawn = draw(surface, seen, pose)
    share = _known(surface, seen, drawn)
    model = pose_normal_equations(
        drawn, seen.features[None], t, weights.appearance_scale, share, surface.renderer
    )
    count = max(len(share), 1)
    unseen = float((seen.valid.reshape(-1)[drawn.pixels] - share).clamp_min(0).sum()) / count
    # The model's mean is over what is known; over all that is covered, what is not costs its charge.
    appearance = float(model.cost) * float(share.sum()) / count + weights.unseen * unseen
    if not len(share):
        appearance = weights.unseen + 1.0
    total = model * weights.appearance
    outline = points = 0.0
    if level.distance is not None:
        edge = contour_normal_equations(
            drawn, find_contour(drawn), level.distance, t, weights.outline_scale * scale
        )
        outline = float(edge.cost)
        total = total + edge * weights.outline
    if matched is not None and len(matched) and level.pixels is not None:
        found = _points_model(matched.points, level.pixels, seen.K, R[0], t[0], weights.points_scale * scale)
        points = float(found.cost)
        total = total + found * weights.points
    cost = weights.appearance * appearance + weights.outline * outline + weights.points * points
    return total, PoseFit(pose, cost, appearance, outline, points, total.matrix[0], 1)


def draw(surface: Surface, observation: Observation, pose: Pose) -> Rendering:
    """Render the object into an observation's window."""
    return render(
        surface.vertices,
        surface.faces,
        surface.face_uvs,
        surface.texture,
        pose.R[None],
        pose.translation[None],
        observation.K[None],
        (observation.window.size, observation.window.size),
        backend=surface.renderer,
    )


def _known(surface: Surface, observation: Observation, drawn: Rendering) -> Tensor:
    """``(P,)`` how far each covered pixel can be compared: inside the frame, not hidden, texture seen before."""
    known = sample_texture(surface.seen, drawn.uv)[:, 0] * observation.valid.reshape(-1)[drawn.pixels]
    return known


def _points_model(
    points: Tensor, pixels: Tensor, K: Tensor, R: Tensor, t: Tensor, scale: float
) -> NormalEquations:
    """Normal equations of the mean Cauchy loss of the distances between projected points and pixels."""
    x_cam = points @ R.T + t
    x_cam = torch.cat([x_cam[:, :2], x_cam[:, 2:].clamp_min(1e-3)], 1)
    projected = x_cam[:, :2] / x_cam[:, 2:] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
    residual = projected - pixels
    squared = residual.square().sum(1)
    count = len(points)
    motion = screen_motion(x_cam, K.expand(count, 3, 3), t.expand(count, 3))
    weight = 2 / (scale**2 + squared) / count
    matrix = torch.einsum("nia,n,nib->ab", motion, weight, motion)
    gradient = torch.einsum("nia,n,ni->a", motion, weight, residual)
    cost = torch.log1p(squared / scale**2).mean()
    return NormalEquations(matrix[None], gradient[None], cost[None])


def moved(pose: Pose, step: Tensor) -> Pose:
    """The pose after a step (v, w) in the camera's axes about its own translation."""
    return from_matrix(rotation_exponential(step[3:]) @ pose.R, pose.translation + step[:3])
