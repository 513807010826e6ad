"""One frame's pose against a known object: Levenberg-Marquardt on pixels, outline and matched points together.

The cost is a weighted sum of three means of Cauchy losses. Covered pixels whose texture no keyframe has seen pull
nowhere; each is charged, so that the object does not turn to where nothing contradicts it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tracking3d.estimation.observation import Observation, halved
from tracking3d.estimation.online.outline import outline_distance
from tracking3d.geometry.pose import Pose, from_matrix, rotation_exponential
from tracking3d.rendering import (
    NormalEquations,
    Rendering,
    contour_normal_equations,
    find_contour,
    pose_normal_equations,
    render,
    sample_texture,
)
from tracking3d.rendering.normal_equations import screen_motion

_DAMPING = 1e-3  # at first; then between the limits
_LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e3
_ENOUGH = 1e-4  # share of the cost below which a gain ends the search
_NEAREST = 1e-3  # depth below which matched points are seen as if they were there


@dataclass(frozen=True, eq=False)
class Surface:
    """The object as poses are fitted to it.

    Attributes:
        vertices: ``(V, 3)`` in object coordinates.
        faces: ``(F, 3)`` int64; face_uvs: ``(F, 3, 2)``.
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
    """What each kind of evidence counts, and where its robust loss turns over.

    Attributes:
        appearance: Of the mean over the covered pixels in the mask and the frame.
        appearance_scale: Difference of features at which the loss is ``log 2``.
        outline: Of the mean along the outline.
        outline_scale: Pixels at full working resolution at which the loss is ``log 2``.
        points: Of the mean over the matched points.
        points_scale: Pixels at full working resolution at which the loss is ``log 2``.
        unseen: What a covered pixel of unseen texture costs, in place of its loss.
    """

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
        appearance: Mean Cauchy loss over the covered pixels in the mask and the frame, unseen ones charged.
        outline: Mean Cauchy loss of the outline; 0 without a mask.
        points: Mean Cauchy loss of the matched points; 0 without any.
        overlap: IoU of what is covered with the mask, inside the frame; 1 without a mask.
        unseen: Share of the comparable pixels whose texture was never seen, in [0, 1].
        information: ``(6, 6)`` matrix of the normal equations, see `tracking3d.rendering.NormalEquations`.
        iterations: Evaluations spent.
    """

    pose: Pose
    cost: float
    appearance: float
    outline: float
    points: float
    overlap: float
    unseen: float
    information: Tensor
    iterations: int


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What a pose is fitted to at one resolution.

    Attributes:
        observation: The frame at this resolution.
        distance: ``(1, S, S)`` see `outline_distance`; None without a mask.
        matched: With pixels of this resolution; None without any.
        weights: With scales in pixels of this resolution.
    """

    observation: Observation
    distance: Tensor | None
    matched: MatchedPoints | None
    weights: PoseWeights

    @classmethod
    def of(cls, observation: Observation, matched: MatchedPoints | None, weights: PoseWeights) -> _Evidence:
        """At an observation's own resolution."""
        distance = outline_distance(observation)[None] if observation.has_mask else None
        return cls(observation, distance, matched if matched is not None and len(matched) else None, weights)


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
        iterations: Most steps at each resolution, each twice the one before, the last one the full working
            resolution. Zeros only evaluate the start.
    """
    pose, spent = start, 0
    for steps, halvings in zip(iterations[:-1], range(len(iterations) - 1, 0, -1), strict=True):
        if steps:
            coarse = _minimize(surface, _halved(observation, matched, weights, halvings), pose, steps)
            pose, spent = coarse.pose, spent + coarse.iterations
    fit = _minimize(surface, _Evidence.of(observation, matched, weights), pose, iterations[-1])
    return replace(fit, iterations=spent + fit.iterations)


def _halved(
    observation: Observation, matched: MatchedPoints | None, weights: PoseWeights, times: int
) -> _Evidence:
    """The evidence at a lower resolution."""
    for _ in range(times):
        observation = halved(observation)
        if matched is not None:
            matched = replace(matched, pixels=(matched.pixels + 0.5) / 2 - 0.5)
        weights = replace(
            weights, outline_scale=weights.outline_scale / 2, points_scale=weights.points_scale / 2
        )
    return _Evidence.of(observation, matched, weights)


def _minimize(surface: Surface, evidence: _Evidence, start: Pose, steps: int) -> PoseFit:
    """Levenberg-Marquardt at one resolution; the cost never rises."""
    damping = _DAMPING
    model, best = _evaluate(surface, evidence, start)
    spent = 1
    for _ in range(steps):
        trial = _moved(best.pose, model.step(damping)[0])
        trial_model, fit = _evaluate(surface, evidence, trial)
        spent += 1
        gain = best.cost - fit.cost
        if gain > 0:
            model, best, damping = trial_model, fit, max(damping / 4, _LEAST_DAMPING)
            if gain < _ENOUGH * (best.cost + gain):
                break
        else:
            damping *= 8
            if damping > _MOST_DAMPING:
                break
    return replace(best, iterations=spent)


def _evaluate(surface: Surface, evidence: _Evidence, pose: Pose) -> tuple[NormalEquations, PoseFit]:
    """The normal equations at a pose, and its costs."""
    weights = evidence.weights
    t = pose.translation[None]
    drawn = drawn_at(surface, evidence.observation, pose)
    pixels, appearance, unseen = _appearance(surface, evidence.observation, drawn, t, weights)
    # The equations are of the mean over what is known, the cost is of all that can be compared.
    model, cost = pixels * (weights.appearance * (1 - unseen)), weights.appearance * appearance
    outline = points = 0.0
    if evidence.distance is not None:
        edge = contour_normal_equations(
            drawn, find_contour(drawn), evidence.distance, t, weights.outline_scale
        )
        outline = float(edge.cost)
        model, cost = model + edge * weights.outline, cost + weights.outline * outline
    if evidence.matched is not None:
        found = _points_model(evidence.matched, evidence.observation.K, pose, weights.points_scale)
        points = float(found.cost)
        model, cost = model + found * weights.points, cost + weights.points * points
    return model, PoseFit(
        pose, cost, appearance, outline, points, _overlap(drawn, evidence.observation), unseen,
        model.matrix[0], 1,
    )  # fmt: skip


def _appearance(
    surface: Surface, observation: Observation, drawn: Rendering, t: Tensor, weights: PoseWeights
) -> tuple[NormalEquations, float, float]:
    """Normal equations of the mean loss over what is known; cost and unseen share of what can be compared."""
    comparable = observation.valid * observation.mask if observation.has_mask else observation.valid
    comparable = comparable.reshape(-1)[drawn.pixels]
    count = float(comparable.sum())
    if not count:
        worst = weights.unseen + 1.0
        return NormalEquations(t.new_zeros(1, 6, 6), t.new_zeros(1, 6), t.new_zeros(1)), worst, 1.0
    # What covers the object, or lies beside it, is left out of the comparison: the mask is to show it.
    known = sample_texture(surface.seen, drawn.uv)[:, 0] * comparable
    model = pose_normal_equations(
        drawn, observation.features[None], t, weights.appearance_scale, known, surface.renderer
    )
    share = float(known.sum()) / count
    return model, float(model.cost) * share + weights.unseen * (1 - share), 1 - share


def _overlap(drawn: Rendering, observation: Observation) -> float:
    """IoU of the covered pixels with the mask, inside the frame."""
    if not observation.has_mask:
        return 1.0
    inside = observation.valid > 0.5
    covered, mask = (drawn.face_index[0] >= 0) & inside, (observation.mask > 0.5) & inside
    return float((covered & mask).sum()) / max(float((covered | mask).sum()), 1.0)


def drawn_at(surface: Surface, observation: Observation, pose: Pose) -> Rendering:
    """The object in an observation's window."""
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


def _points_model(matched: MatchedPoints, K: Tensor, pose: Pose, scale: float) -> NormalEquations:
    """Normal equations of the mean Cauchy loss of the distances between projected points and pixels."""
    t, count = pose.translation, len(matched)
    x_cam = matched.points @ pose.R.T + t
    x_cam = torch.cat([x_cam[:, :2], x_cam[:, 2:].clamp_min(_NEAREST)], 1)
    projected = x_cam[:, :2] / x_cam[:, 2:] * torch.stack([K[0, 0], K[1, 1]]) + K[:2, 2]
    residual = projected - matched.pixels
    squared = residual.square().sum(1)
    motion = screen_motion(x_cam, K.expand(count, 3, 3), t.expand(count, 3))
    weight = 2 / (scale**2 + squared) / count
    matrix = torch.einsum("nia,n,nib->ab", motion, weight, motion)
    gradient = torch.einsum("nia,n,ni->a", motion, weight, residual)
    cost = torch.log1p(squared / scale**2).mean()
    return NormalEquations(matrix[None], gradient[None], cost[None])


def _moved(pose: Pose, step: Tensor) -> Pose:
    """The pose after a step (v, w) in the camera's axes about its own translation."""
    return from_matrix(rotation_exponential(step[3:]) @ pose.R, pose.translation + step[:3])
