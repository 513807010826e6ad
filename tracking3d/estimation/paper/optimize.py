"""Adam over poses, shape and texture, with the paper's stopping rule or a stricter one (section 3.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch

from tracking3d.estimation.paper.problem import Losses, Parameters, Problem
from tracking3d.estimation.shape import flatten
from tracking3d.rendering import channels_last

Free = Literal["all", "pose"]


@dataclass(frozen=True, eq=False)
class Optimum:
    """The result of an optimization."""

    # the estimate: the best state so far, or the initial one if the optimization failed numerically
    parameters: Parameters
    losses: Losses  # the terms at the estimate
    total: float  # their weighted sum
    iterations: int  # number of evaluations
    reason: str = ""  # empty, or why there is no usable estimate


def optimize(
    problem: Problem,
    start: Parameters,
    *,
    iterations: int,
    tau: float,
    fixed: int = 0,
    free: Free = "all",
) -> Optimum:
    """Minimize the problem's total loss.

    Args:
        problem: What to explain.
        start: The initial parameters.
        iterations: Most evaluations.
        tau: Appearance loss at which the paper's rule (``stop: threshold``) ends.
        fixed: Number of leading frames whose pose does not move: the gauge.
        free: ``"pose"`` leaves shape and texture as they are.
    """
    config, rates = problem.config, problem.config.learning_rates
    translation, quaternion = start.translation[fixed:].clone(), start.quaternion[fixed:].clone()
    offsets, texture = start.offsets.clone(), channels_last(start.texture).clone()
    groups = [(translation, rates.translation), (quaternion, rates.rotation)]
    if free == "all":
        groups += [(offsets, rates.vertices), (texture, rates.texture)]
    groups = [(tensor, rate) for tensor, rate in groups if tensor.numel()]
    for tensor, _ in groups:
        tensor.requires_grad_()
    adam = torch.optim.Adam([{"params": [tensor], "lr": rate} for tensor, rate in groups])

    best: Optimum | None = None
    progressed = 0
    for iteration in range(1, iterations + 1):
        parameters = Parameters(
            torch.cat([start.translation[:fixed], translation]),
            torch.cat([start.quaternion[:fixed], quaternion]),
            offsets,
            texture,
        )
        losses = problem.losses(parameters)
        total = losses.total(config.weights)
        value = float(total.detach())
        if not torch.isfinite(total):
            return _numerical_failure(best, start, losses, value, iteration)
        if config.stop == "threshold":
            converged = float(losses.features.detach().mean()) < tau
            if converged or iteration == iterations:
                return Optimum(parameters.detach(), losses.detach(), value, iteration)
        elif best is None or value < best.total:
            # The initial parameters count as progress only once: an unmoved pose never wins by being first.
            if best is None or value < best.total - 1e-4 * abs(best.total):
                progressed = iteration
            best = Optimum(parameters.detach(), losses.detach(), value, iteration)
        elif iteration - progressed >= config.patience:
            break
        adam.zero_grad(set_to_none=True)
        total.backward()
        adam.step()
        if problem.shape.flat and free == "all":
            with torch.no_grad():
                offsets.copy_(flatten(problem.shape.rest + offsets) - problem.shape.rest)
    assert best is not None
    return replace(best, iterations=iteration)


def _numerical_failure(
    best: Optimum | None, start: Parameters, losses: Losses, value: float, iteration: int
) -> Optimum:
    reason = f"the loss became {value} in iteration {iteration}"
    if best is not None:
        return replace(best, iterations=iteration, reason=reason)
    return Optimum(start, losses.detach(), value, iteration, reason)
