"""A start that solves the first few frames together, from several hypotheses of how the object turns.

Frame by frame against a wrong first shape the estimate locks into depth reversal or too little rotation while
its silhouette still fits. The hypothesis that re-renders all first frames best wins.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.config.solvers import PaperConfig
from tracking3d.estimation.observation import ObservationBatch, halved
from tracking3d.estimation.paper.belief import PaperState, PosedObservation
from tracking3d.estimation.paper.optimize import Optimum, optimize
from tracking3d.estimation.paper.problem import Parameters, Problem
from tracking3d.geometry.pose import Pose, from_matrix, rotation_exponential

RATES = (3.0, 8.0)
"""Degrees a frame that the hypotheses turn."""
DIRECTIONS = 8
_SEMIFINALISTS = 6
_FINALISTS = 2


def joint_start(
    belief: PaperState, frames: list[PosedObservation], config: PaperConfig, tau: float
) -> Optimum:
    """Solve shape, texture and all poses of ``frames``; the first pose is fixed.

    Args:
        belief: Its shape and texture are what every hypothesis starts from.
        frames: The first frames, with the poses found one by one: one of the hypotheses.
        config: The solver's constants; ``stop`` is taken as ``plateau``.
        tau: The encoder's convergence threshold.
    """
    config = config.model_copy(update={"stop": "plateau", "patience": config.start_iterations})
    coarse, fine = (
        Problem(belief.shape, ObservationBatch.of(observations), config, backend=belief.renderer)
        for observations in (
            [halved(frame.observation) for frame in frames],
            [frame.observation for frame in frames],
        )
    )
    spent = 0
    optima: list[Optimum] = []
    starts = [belief.parameters(frames), *hypotheses(belief, frames)]
    for problem, survivors, share in (
        (coarse, len(starts), 3),
        (coarse, _SEMIFINALISTS, 1),
        (fine, _FINALISTS, 1),
    ):
        starts = starts[:survivors]
        iterations = max(config.start_iterations // share, 1)
        optima = [optimize(problem, start, iterations=iterations, tau=tau, fixed=1) for start in starts]
        spent += sum(optimum.iterations for optimum in optima)
        optima.sort(key=lambda optimum: math.inf if optimum.reason else optimum.total)
        starts = [optimum.parameters for optimum in optima]
    return replace(optima[0], iterations=spent)


def hypotheses(belief: PaperState, frames: list[PosedObservation]) -> list[Parameters]:
    """No rotation; the rotations found so far mirrored in depth; turning in eight directions at two rates.

    Translations are those found so far: they are seen directly.
    """
    first, found = frames[0].pose, Pose.stack([frame.pose for frame in frames])
    elapsed = [frame.observation.index - frames[0].observation.index for frame in frames]
    still = Pose(found.translation, first.quaternion.expand_as(found.quaternion))
    variants = [still, _mirrored(first, found)]
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = first.translation.new_tensor([math.cos(angle), math.sin(angle), 0.0])
        variants += [_turned(first, found, axis, rate, elapsed) for rate in RATES]
    return [
        Parameters(poses.translation, poses.quaternion, belief.offsets, belief.texture) for poses in variants
    ]


def _turned(first: Pose, found: Pose, axis: Tensor, rate: float, elapsed: list[int]) -> Pose:
    """The first rotation turned about ``axis`` by ``rate`` degrees in each of the elapsed frames, by 60 at most."""
    angles = axis.new_tensor([math.radians(max(min(rate * frames, 60.0), -60.0)) for frames in elapsed])
    turn = rotation_exponential(angles[:, None] * functional.normalize(axis, dim=0))
    return from_matrix(turn @ first.R, found.translation)


def _mirrored(first: Pose, found: Pose) -> Pose:
    """The rotations since the first frame with their tilt out of the image plane reversed (Necker)."""
    delta = found.R @ first.R.T
    flip = torch.diag(delta.new_tensor([1.0, 1.0, -1.0]))
    return from_matrix(flip @ delta @ flip @ first.R, found.translation)
