"""A start that solves the first few frames together, from several hypotheses of how the object turns.

Frame by frame against a wrong first shape the estimate locks into depth reversal or too little rotation while
its silhouette still fits. The hypothesis that re-renders all first frames best wins.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from tracking3d.config.solvers import PaperConfig
from tracking3d.estimation.observation import Batch, downsample
from tracking3d.estimation.paper.optimize import Optimum, optimize
from tracking3d.estimation.paper.problem import Parameters, Problem
from tracking3d.estimation.paper.state import Keyframe, PaperState
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

RATES = (3.0, 8.0)
"""Degrees a frame that the hypotheses turn."""
DIRECTIONS = 8
_SEMIFINALISTS = 6
_FINALISTS = 2


def initialize_jointly(state: PaperState, frames: list[Keyframe], config: PaperConfig, tau: float) -> Optimum:
    """Solve shape, texture and all poses of ``frames``; the first pose is fixed.

    Args:
        state: Its shape and texture are what every hypothesis starts from.
        frames: The first frames, with the poses found one by one: one of the hypotheses.
        config: The solver's constants; ``stop`` is taken as ``plateau``.
        tau: The encoder's convergence threshold.
    """
    config = config.model_copy(update={"stop": "plateau", "patience": config.init_iterations})
    coarse, fine = (
        Problem(state.shape, Batch.of(observations), config, backend=state.renderer)
        for observations in (
            [downsample(frame.observation) for frame in frames],
            [frame.observation for frame in frames],
        )
    )
    spent = 0
    optima: list[Optimum] = []
    starts = [state.parameters(frames), *hypotheses(state, frames)]
    for problem, survivors, share in (
        (coarse, len(starts), 3),
        (coarse, _SEMIFINALISTS, 1),
        (fine, _FINALISTS, 1),
    ):
        starts = starts[:survivors]
        iterations = max(config.init_iterations // share, 1)
        optima = [optimize(problem, start, iterations=iterations, tau=tau, fixed=1) for start in starts]
        spent += sum(optimum.iterations for optimum in optima)
        optima.sort(key=lambda optimum: math.inf if optimum.reason else optimum.total)
        starts = [optimum.parameters for optimum in optima]
    return replace(optima[0], iterations=spent)


def hypotheses(state: PaperState, frames: list[Keyframe]) -> list[Parameters]:
    """No rotation; the rotations found so far mirrored in depth; turning in eight directions at two rates.

    Translations are those found so far: they are seen directly.
    """
    first = frames[0].pose
    found = [frame.pose for frame in frames]
    still = [Pose(pose.translation, first.quaternion) for pose in found]
    variants = [still, [_mirror(first, pose) for pose in found]]
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = first.translation.new_tensor([math.cos(angle), math.sin(angle), 0.0])
        for rate in RATES:
            variants.append([_rotate(first, frame, axis, rate, frames[0]) for frame in frames])
    return [
        state.parameters(
            [Keyframe(frame.observation, pose) for frame, pose in zip(frames, poses, strict=True)]
        )
        for poses in variants
    ]


def _rotate(first: Pose, frame: Keyframe, axis: Tensor, rate: float, start: Keyframe) -> Pose:
    degrees = rate * (frame.observation.index - start.observation.index)
    degrees = max(min(degrees, 60.0), -60.0)
    return from_matrix(rotation_about(axis, degrees) @ first.R, frame.pose.translation)


def _mirror(first: Pose, pose: Pose) -> Pose:
    """The rotation since the first frame with its tilt out of the image plane reversed (Necker)."""
    delta = pose.R @ first.R.T
    flip = torch.diag(delta.new_tensor([1.0, 1.0, -1.0]))
    return from_matrix(flip @ delta @ flip @ first.R, pose.translation)
