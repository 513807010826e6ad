"""Bundle adjustment: poses and surface points that explain tracked pixels best.

Levenberg-Marquardt on a Cauchy loss by iteratively reweighted least squares. The points are eliminated from every
step by the Schur complement, so that a system of six unknowns a frame remains (Triggs et al., "Bundle adjustment:
a modern synthesis", 1999, section 6.1).

Gauge: the leading ``fixed`` frames do not move. With one of them the size of everything is still free; the median
depth of the points in frame 0 is then kept as the start has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.levenberg_marquardt import Damping, damped, minimizer
from tracking3d.points.bundle_adjustment.reprojection import (
    FloatArray,
    apply_pose_steps,
    finite_rows,
    transform_to_camera,
)

_DAMPING = Damping(least=1e-9, most=1e9, decrease=10, increase=10, tries=6)


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points of an object followed through F frames."""

    pixels: FloatArray  # (F, N, 2) in pixels of the full frame; anything where not visible
    visible: NDArray[np.bool_]  # (F, N) bool
    weight: FloatArray | None = None  # (F, N) how much each observation counts; all the same if None

    def weights(self) -> FloatArray:
        """``(F, N)`` weights, 0 wherever there is nothing to see: not visible, or a value that is not finite."""
        weight = np.ones(self.visible.shape) if self.weight is None else self.weight
        sound = self.visible & np.isfinite(self.pixels).all(-1) & np.isfinite(weight)
        return np.where(sound, np.maximum(np.nan_to_num(weight), 0.0), 0.0)


def _nothing() -> FloatArray:
    return np.empty((0, 0))


@dataclass(frozen=True, eq=False)
class Structure:
    """Poses and points.

    Attributes:
        R: ``(F, 3, 3)`` and
        t: ``(F, 3)`` of every frame's ``T_cam_obj``.
        points: ``(N, 3)`` in object coordinates; nan for points that are not known.
        focal_factor: The focal lengths of K are to be multiplied by this.
        cost: Mean Cauchy loss over the observations, by weight; the points' prior is part of it.
        residual: ``(F, N)`` distance in pixels between track and projection; nan if unseen.
        iterations: Steps that were tried.
        origin: In a word, where it comes from.
        focal_curvature: Second derivative of the sum of losses by the logarithm of the focal factor, with poses and
            points free to follow; 0 if the focal length was not solved for.
    """

    R: FloatArray
    t: FloatArray
    points: FloatArray
    focal_factor: float = 1.0
    cost: float = math.inf
    residual: FloatArray = field(default_factory=_nothing)
    iterations: int = 0
    origin: str = ""
    focal_curvature: float = 0.0


@dataclass(frozen=True, eq=False)
class System:
    """Normal equations: poses (and focal length) C, points N, and what couples them."""

    poses: FloatArray  # (C, C)
    points: FloatArray  # (N, 3, 3)
    coupling: FloatArray  # (N, 3, C)
    poses_gradient: FloatArray  # (C,)
    points_gradient: FloatArray  # (N, 3)

    def step(self, damping: float) -> tuple[FloatArray, FloatArray] | None:
        """Damped step of poses ``(C,)`` and points ``(N, 3)``; None if there is none."""
        poses, points = damped(self.poses, damping), damped(self.points, damping)
        from tracking3d.points.bundle_adjustment.kernels import normal_equations

        return normal_equations.step(poses, points, self.coupling, self.poses_gradient, self.points_gradient)

    def last_curvature(self) -> float:
        """Curvature along the last unknown of the poses, with all others eliminated; 0 if it is not known."""
        poses, points = damped(self.poses, _DAMPING.least), damped(self.points, _DAMPING.least)
        try:
            coupling = np.linalg.solve(np.linalg.cholesky(points), self.coupling).reshape(-1, len(poses))
            reduced = poses - coupling.T @ coupling
            others = np.linalg.solve(reduced[:-1, :-1], reduced[:-1, -1])
        except np.linalg.LinAlgError:
            return 0.0
        curvature = float(reduced[-1, -1] - reduced[-1, :-1] @ others)
        return max(curvature, 0.0) if math.isfinite(curvature) else 0.0


@dataclass(frozen=True, eq=False)
class AdjustmentProblem:
    """What stays the same during one adjustment; arguments of `adjust`, with nothing in them that is not finite."""

    pixels: FloatArray
    weight: FloatArray
    K: FloatArray
    fixed: int
    scale: float
    free_focal: bool
    prior: FloatArray
    prior_weight: FloatArray

    def intrinsics(self, focal_factor: float) -> FloatArray:
        """``K`` of other focal lengths."""
        K = self.K.copy()
        K[0, 0] *= focal_factor
        K[1, 1] *= focal_factor
        return K

    def evaluate(self, at: Structure) -> Structure:
        """With its cost and its residuals."""
        from tracking3d.points.bundle_adjustment.kernels import normal_equations

        given = self.pixels, self.weight, self.intrinsics(at.focal_factor), at.R, at.t, at.points
        total, residual = normal_equations.evaluate(*given, self.scale)
        total += float(np.sum(self.prior_weight * np.sum((at.points - self.prior) ** 2, 1)))
        return replace(at, cost=float(total / max(self.weight.sum(), 1e-12)), residual=residual)

    def linearize(self, at: Structure) -> System:
        """The quadratic model of the weighted sum of losses."""
        from tracking3d.points.bundle_adjustment.kernels import normal_equations

        given = self.pixels, self.weight, self.intrinsics(at.focal_factor), at.R, at.t, at.points
        system = System(*normal_equations.linearize(*given, self.scale, self.fixed, self.free_focal))
        points = system.points + 2 * self.prior_weight[:, None, None] * np.eye(3)
        points_gradient = system.points_gradient + 2 * self.prior_weight[:, None] * (at.points - self.prior)
        return replace(system, points=points, points_gradient=points_gradient)

    def stepped(self, at: Structure, system: System, damping: float) -> Structure:
        """After a damped step, with its cost; this is infinite if there is no step."""
        step = system.step(damping)
        return replace(at, cost=math.inf) if step is None else self.evaluate(self.step_by(at, *step))

    def step_by(self, at: Structure, d_poses: FloatArray, d_points: FloatArray) -> Structure:
        """After a step."""
        factor, t = 1.0, at.t
        if self.free_focal:
            factor = float(np.exp(np.clip(d_poses[-1], -0.5, 0.5)))
            t = t * [1.0, 1.0, factor]
            d_poses = d_poses[:-1]
        R_moved, t_moved = apply_pose_steps(at.R[self.fixed :], t[self.fixed :], d_poses.reshape(-1, 6))
        R, t = np.concatenate([at.R[: self.fixed], R_moved]), np.concatenate([t[: self.fixed], t_moved])
        return replace(at, R=R, t=t, points=at.points + d_points, focal_factor=at.focal_factor * factor)


def adjust(
    tracks: Tracks,
    K: FloatArray,
    start: Structure,
    *,
    fixed: int = 1,
    scale: float = 1.0,
    free_focal: bool = False,
    iterations: int = 20,
    converged: float = 1e-7,
    point_prior: FloatArray | None = None,
    point_prior_weight: float = 0.0,
) -> Structure:
    """The poses and points of least robust reprojection error near a start; never worse than the start.

    Args:
        tracks: F frames, N points.
        K: ``(3, 3)`` of the full frame, without skew.
        start: Points that are nan stay so and are not used.
        fixed: How many leading frames keep their pose.
        scale: Residual in pixels at which the Cauchy loss is ``log 2``.
        free_focal: Solve for one factor of both focal lengths too. Fixed frames then keep their rotation and the
            place where the object's origin is seen; their depth goes with the focal length, so that the object
            keeps its size. Only perspective within the object tells the lens: after a turn of 30 degrees with 0.3
            pixels of noise and a radius of 80 pixels, fields of view from 25 to 65 degrees come out to 2 degrees
            and one of 10 between 8 and 13. After a few degrees, or of a flat object, the cost hardly depends on
            it and the answer means nothing. A start from a lens more than twice as wide or narrow may not get
            there: start from several and compare their costs.
        iterations: The most steps that are tried.
        converged: Share of the cost that a step has to gain for another one to follow.
        point_prior: ``(N, 3)`` where the points should be, for instance on a mesh; nan for those that are free.
        point_prior_weight: What a point at distance 1 from its place costs; an observation at a residual of one
            scale costs ``log 2``.

    Raises:
        ValueError: If shapes do not fit.
    """
    frames, count = tracks.visible.shape
    if start.R.shape != (frames, 3, 3) or start.points.shape != (count, 3) or not 0 <= fixed <= frames:
        raise ValueError(
            "the start must have the frames and points of the tracks, and fixed be one of its frames"
        )
    known = finite_rows(start.points)
    prior = np.full((count, 3), np.nan) if point_prior is None else point_prior
    held = known & finite_rows(prior)
    problem = AdjustmentProblem(
        pixels=np.where(tracks.visible[..., None], np.nan_to_num(tracks.pixels), 0.0),
        weight=tracks.weights() * known,
        K=np.asarray(K, np.float64),
        fixed=fixed,
        scale=scale,
        free_focal=free_focal,
        prior=np.where(held[:, None], prior, 0.0),
        prior_weight=np.where(held, point_prior_weight, 0.0),
    )
    begun = replace(start, points=np.where(known[:, None], start.points, 0.0))
    minimize = minimizer(AdjustmentProblem.linearize, AdjustmentProblem.stepped)
    options = _DAMPING._replace(converged=converged)
    best, tried = minimize(problem, problem.evaluate(begun), options, iterations)
    if fixed == 1 and not problem.prior_weight.any():
        best = problem.evaluate(_with_depth_of(begun, best, problem.weight.max(0, initial=0.0) > 0))
    points = np.where(known[:, None], best.points, np.nan)
    curvature = problem.linearize(best).last_curvature() if free_focal else 0.0
    return replace(best, points=points, iterations=tried, focal_curvature=curvature)


def _with_depth_of(reference: Structure, structure: Structure, used: NDArray[np.bool_]) -> Structure:
    """Everything scaled about frame 0's camera to the reference's median depth there; no image changes."""
    if not used.any():
        return structure
    before, after = (
        float(np.median(transform_to_camera(s.R[0], s.t[0], s.points[used])[:, 2]))
        for s in (reference, structure)
    )
    factor = before / after * structure.focal_factor / reference.focal_factor
    if not (math.isfinite(factor) and factor > 0):
        return structure
    R0, t0 = structure.R[0], structure.t[0]
    points = (factor * structure.points @ R0.T + (factor - 1) * t0) @ R0
    t = factor * structure.t + (1 - factor) * (structure.R @ (R0.T @ t0))
    return replace(structure, t=t, points=points)


# Depth reversal: the other explanation of the same tracks.
#
# Seen from afar, points that turn one way and points of a shape with all depths negated that turns the other way look
# the same (Necker's cube; Koenderink and van Doorn, "Affine structure from motion", 1991). Once an estimate has taken
# the wrong one, nothing brings it back by small steps; but the right one is known, and perspective, turns about more
# than one axis and the surface itself tell which it is.

_ROBUST_TURNS = 5


@dataclass(frozen=True, eq=False)
class Reversal:
    """Depths negated about one point, the same in every view up to perspective."""

    centre: FloatArray  # (3,) in object coordinates; it stays where every view sees it
    direction: FloatArray  # (3,) unit vector in object coordinates, along which points are negated

    def points(self, points: FloatArray) -> FloatArray:
        """``(N, 3)`` points reversed."""
        depth = (points - self.centre) @ self.direction
        return points - 2 * depth[:, None] * self.direction

    def poses(self, T_cam_obj: FloatArray) -> FloatArray:
        """``(..., 4, 4)`` poses at which reversed points are seen in the same directions, but for perspective."""
        placed = T_cam_obj[..., :3, :3] @ self.centre + T_cam_obj[..., :3, 3]
        sight = placed / np.linalg.norm(placed, axis=-1, keepdims=True)
        reversed_T = T_cam_obj.copy()
        R = _reflection(sight) @ T_cam_obj[..., :3, :3] @ _reflection(self.direction)
        reversed_T[..., :3, :3] = R
        reversed_T[..., :3, 3] = placed - R @ self.centre
        return reversed_T

    def surface(self, vertices: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
        """A surface that follows its points through their reversal.

        What was seen from the front is seen from the front still, so that the surface is not turned inside out: it is
        sheared along the direction, as much as the points say that its slant has changed.

        Args:
            vertices: ``(V, 3)``.
            before: ``(N, 3)`` points on it.
            after: ``(N, 3)`` where they have come to lie.

        Returns:
            ``(V, 3)`` vertices.
        """
        shift = (after - before) @ self.direction
        across = np.column_stack([np.ones(len(before)), self._across(before)])
        weight: FloatArray = np.ones(len(before))
        slant: FloatArray = np.zeros(4)
        for _ in range(_ROBUST_TURNS):
            slant = np.asarray(
                np.linalg.lstsq(weight[:, None] * across, weight * shift, rcond=None)[0], np.float64
            )
            left = np.abs(shift - across @ slant)
            far = left / (2 * float(np.median(left)) + 1e-12)
            weight = np.asarray(1 / np.sqrt(1 + far**2), np.float64)
        depth = np.column_stack([np.ones(len(vertices)), self._across(vertices)]) @ slant
        return vertices + depth[:, None] * self.direction

    def _across(self, points: FloatArray) -> FloatArray:
        """What is left of points without their depth."""
        offset = points - self.centre
        return offset - (offset @ self.direction)[:, None] * self.direction


def reversal_of(points: FloatArray, T: FloatArray) -> Reversal:
    """The reversal that leaves one view's pose as it is.

    Args:
        points: ``(N, 3)`` in object coordinates.
        T: ``(4, 4)`` pose of that view.
    """
    centre = points.mean(0)
    placed = T[:3, :3] @ centre + T[:3, 3]
    return Reversal(centre, T[:3, :3].T @ (placed / np.linalg.norm(placed)))


def _reflection(normal: FloatArray) -> FloatArray:
    """``(..., 3, 3)`` reflection of ``(..., 3)`` unit normals."""
    return np.asarray(np.eye(3) - 2 * normal[..., :, None] * normal[..., None, :])
