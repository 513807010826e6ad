"""Levenberg-Marquardt, for robust losses by iteratively reweighted least squares: one loop for all that is fitted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray


class Evaluated(Protocol):
    """A state of the unknowns with its cost."""

    @property
    def cost(self) -> float:
        """What is minimized."""


class Damping(NamedTuple):
    """How the damping goes on, and when the loop ends. A named tuple, which kernels can take."""

    first: float = 1e-3  # share of each diagonal entry that is added to it
    least: float = 1e-6
    most: float = 1e3  # above it, no step is expected to gain anything
    decrease: float = 4.0  # divisor after a step that gains
    increase: float = 8.0  # factor after one that does not
    converged: float = 1e-4  # share of the cost below which a gain is small
    small_gains: int = 1  # in a row that end the loop
    tries: int = (
        0  # steps without gain in a row that end it, whatever is left of the iterations; 0: no such number
    )


S = TypeVar("S", bound=Evaluated)


def minimizer(
    linearize: Callable[[Any, S], Any], step: Callable[[Any, S, Any, float], S]
) -> Callable[[Any, S, Damping, int], tuple[S, int]]:
    """The loop for one kind of problem, which a kernel may compile if it can compile both functions.

    Args:
        linearize: The normal equations of a problem at a state.
        step: The state that a step leads to, from problem, state, normal equations and damping; at infinite cost if
            there is no step.

    Returns:
        From problem, first state, damping and the most steps that are tried: the state of least cost that damped steps
        lead to, never worse than the first, and how many were tried.
    """

    def minimize(problem: Any, start: S, damping: Damping, iterations: int) -> tuple[S, int]:
        best, share, tried, refused, small = start, damping.first, 0, 0, 0
        while tried < iterations or 0 < refused < damping.tries:
            if refused == 0:
                model = linearize(problem, best)
            tried += 1
            trial = step(problem, best, model, share)
            gain = best.cost - trial.cost
            if gain > 0:
                small = small + 1 if gain < damping.converged * best.cost else 0
                best, share, refused = trial, max(share / damping.decrease, damping.least), 0
                if small == damping.small_gains:
                    break
            else:
                share, refused = share * damping.increase, refused + 1
                if share > damping.most or refused == damping.tries:
                    break
        return best, tried

    return minimize


def damped(matrix: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
    """``(..., C, C)`` with a share of each diagonal entry more, and a floor that keeps unseen parts still."""
    diagonal = np.einsum("...ii->...i", matrix)
    floor = 1e-9 * diagonal.max(initial=0.0) + 1e-12
    return matrix + (damping * diagonal + floor)[..., None] * np.eye(matrix.shape[-1])
