"""Refines poses of one frame against the map: Levenberg-Marquardt on appearance, outline and matched points together.

The cost is a weighted sum of three means of Cauchy losses. Covered pixels whose texture no keyframe has seen pull
nowhere; each is charged, so that the object does not turn to where nothing contradicts it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.optimization.types import NOTHING_SEEN, PoseFit, PoseWeights
from tracking3d.geometry.levenberg_marquardt import Damping, minimizer
from tracking3d.geometry.pose import Pose, from_matrix
from tracking3d.points.bundle_adjustment.reprojection import EvaluatedPose, FloatArray, apply_pose_steps
from tracking3d.rendering import MatchedPoints, NormalEquations, Scales, Surface, pose_terms
from tracking3d.rendering.backend import use_numba

_DEFAULT_WEIGHTS = PoseWeights()


@dataclass(frozen=True, eq=False)
class _Evidence:
    """The evidence that poses are fitted to, at one resolution."""

    surface: Surface
    observation: Observation  # the frame at this resolution
    matched: MatchedPoints | None  # with pixels of this resolution; None without any
    weights: PoseWeights  # with scales in pixels of this resolution

    def half(self) -> _Evidence:
        """At half the resolution."""
        matched, weights = self.matched, self.weights
        if matched is not None:
            matched = replace(matched, pixels=(matched.pixels + 0.5) / 2 - 0.5)
        outline, points = weights.outline_scale / 2, weights.points_scale / 2
        weights = replace(weights, outline_scale=outline, points_scale=points)
        return _Evidence(self.surface, self.observation.half, matched, weights)


def refine_pose(
    surface: Surface,
    observation: Observation,
    start: Pose,
    matched: MatchedPoints | None = None,
    weights: PoseWeights = _DEFAULT_WEIGHTS,
    iterations: tuple[int, ...] = (4, 5),
) -> PoseFit:
    """Fit one pose; see `refine_poses`."""
    return refine_poses(surface, observation, [start], matched, weights, iterations)[0]


def refine_poses(
    surface: Surface,
    observation: Observation,
    starts: Sequence[Pose],
    matched: MatchedPoints | None = None,
    weights: PoseWeights = _DEFAULT_WEIGHTS,
    iterations: tuple[int, ...] = (4, 5),
) -> list[PoseFit]:
    """Fit one frame's pose from several initial poses, coarse to fine, each independently.

    Args:
        surface: The object.
        observation: The frame.
        starts: The initial poses.
        matched: Points with known places in the frame's window at full working resolution.
        weights: The weights of the kinds of evidence.
        iterations: Most steps at each resolution, each twice the one before, the last one the full working
            resolution. Zeros only evaluate the starts.
    """
    if not starts:
        return []
    points = matched if matched is not None and len(matched) else None
    levels = [_Evidence(surface, observation, points, weights)]
    for _ in iterations[1:]:
        levels.append(levels[-1].half())
    first_R = torch.stack([pose.R for pose in starts]).cpu().double().numpy()
    first_t = torch.stack([pose.translation for pose in starts]).cpu().double().numpy()
    R, t, spent = first_R, first_t, np.zeros(len(starts), np.int64)
    for level, steps in zip(levels[::-1], iterations, strict=True):
        if steps or level is levels[0]:
            found, tried = zip(*_minimize(level, R, t, steps), strict=True)
            R, t = (np.stack(part) for part in ([fit.R for fit in found], [fit.t for fit in found]))
            spent += 1 + np.array(tried)
    moved = np.not_equal(R, first_R).any((1, 2)) | np.not_equal(t, first_t).any(1)
    return [
        PoseFit.of(fit, from_matrix(*_on_device(surface, fit.R, fit.t)) if moved[n] else start, int(spent[n]))
        for n, (start, fit) in enumerate(zip(starts, found, strict=True))
    ]


def _minimize(
    evidence: _Evidence, R: FloatArray, t: FloatArray, steps: int
) -> list[tuple[EvaluatedPose, int]]:
    """Poses ``(B, 3, 3)`` and ``(B, 3)`` fitted at one resolution, with the numbers of steps tried."""
    surface, target = evidence.surface, evidence.observation.target
    if use_numba(surface.renderer, surface.vertices, surface.texture, target.features):
        from tracking3d.estimation.online.optimization.kernels import pose_refinement

        return pose_refinement.minimize(surface, target, evidence.matched, evidence.weights, R, t, steps)
    minimize = minimizer(_model, _step)
    return [minimize(evidence, start, Damping(), steps) for start in _evaluate(evidence, R, t)]


def _model(evidence: _Evidence, at: EvaluatedPose) -> NormalEquations:
    parts = (torch.from_numpy(np.asarray(part)[None]) for part in (at.matrix, at.gradient, at.cost))
    return NormalEquations(*parts)


def _step(evidence: _Evidence, at: EvaluatedPose, model: NormalEquations, damping: float) -> EvaluatedPose:
    return _evaluate(evidence, *apply_pose_steps(at.R[None], at.t[None], model.step(damping).numpy()))[0]


def _evaluate(evidence: _Evidence, R: FloatArray, t: FloatArray) -> list[EvaluatedPose]:
    """Poses with their costs and normal equations."""
    surface, weights = evidence.surface, evidence.weights
    scales = Scales(weights.appearance_scale, weights.outline_scale, weights.points_scale)
    target, poses = evidence.observation.target, _on_device(surface, R, t)
    terms = pose_terms(surface, target, *poses, evidence.matched, scales)
    comparable = terms.comparable.numpy()
    nothing = comparable == 0
    unseen = np.where(nothing, 1.0, 1 - terms.known.numpy() / np.where(nothing, 1.0, comparable))
    outline, points = terms.outline.cost.numpy(), terms.points.cost.numpy()
    appearance = (
        terms.appearance.cost.numpy() * (1 - unseen) + weights.unseen * unseen + NOTHING_SEEN * nothing
    )
    # The equations are of the mean over what is known, the cost is of all that can be compared.
    model = (
        terms.appearance * torch.from_numpy(weights.appearance * (1 - unseen))
        + terms.outline * weights.outline
        + terms.points * weights.points
    )
    cost = weights.appearance * appearance + weights.outline * outline + weights.points * points
    details = np.column_stack([appearance, outline, points, terms.overlap.numpy(), unseen])
    parts = cost.tolist(), R, t, details, model.matrix.numpy(), model.gradient.numpy()
    return [EvaluatedPose(*each) for each in zip(*parts, strict=True)]


def _on_device(surface: Surface, R: FloatArray, t: FloatArray) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(R).to(surface.vertices), torch.from_numpy(t).to(surface.vertices)


def render_cost(fit: PoseFit, weights: PoseWeights, mask_weight: float) -> float:
    """What poses from different points are compared by: the cost without them."""
    missed = mask_weight * (1 - fit.overlap)
    return weights.appearance * fit.appearance + weights.outline * mask_weight * fit.outline + missed


TURN = 10.0
"""Degrees of the rotation whose cost is computed."""


def least_constrained_axis(fit: PoseFit) -> tuple[float, NDArray[np.float64]]:
    """The cost of rotating the object about its least constrained axis, and that axis ``(3,)`` in camera axes.

    By the normal equations: translation and the other rotations may compensate. A solid of revolution without texture
    rotates about its axis at no cost, whatever its outline says otherwise.

    Returns:
        The cost of a rotation by `TURN` degrees, in units of `PoseFit.cost`; 0 if nothing constrains it.
    """
    information = fit.information.double().cpu().numpy()
    moves, coupling, turns = information[:3, :3], information[:3, 3:], information[3:, 3:]
    floor = 1e-9 * max(float(np.trace(moves)), 1e-12)
    held = turns - coupling.T @ np.linalg.solve(moves + floor * np.eye(3), coupling)
    if not np.isfinite(held).all():
        return 0.0, np.array([0.0, 0.0, 1.0])
    values, axes = np.linalg.eigh((held + held.T) / 2)
    return max(float(values[0]), 0.0) * math.radians(TURN) ** 2 / 2, axes[:, 0]
