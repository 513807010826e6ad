"""One loop for all least squares: the damping follows what steps gain, and no state is worse than the first."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from tracking3d.geometry.levenberg_marquardt import Damping, damped, minimizer


class Curve(NamedTuple):
    """Rosenbrock's valley, as the sum of two squares."""

    cost: float
    x: np.ndarray


def at(x: np.ndarray) -> Curve:
    return Curve(float((1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2), x)


def linearized(_, curve):
    J = np.array([[-1.0, 0.0], [-20 * curve.x[0], 10.0]])
    r = np.array([1 - curve.x[0], 10 * (curve.x[1] - curve.x[0] ** 2)])
    return J.T @ J, J.T @ r


def stepped(_, curve, model, damping):
    return at(curve.x - np.linalg.solve(damped(model[0], damping), model[1]))


def test_a_curved_valley_is_followed_to_its_end():
    best, tried = minimizer(linearized, stepped)(None, at(np.array([-1.2, 1.0])), Damping(converged=0), 100)
    assert best.x == pytest.approx([1, 1], abs=1e-6) and tried < 100


def recorded(costs, damping, iterations):
    """Final cost, steps, and each step's damping, where steps lead to these costs whatever the damping."""
    used, left = [], iter(costs)

    def step(_, state, model, share):
        used.append(share)
        return Curve(next(left), state.x)

    best, tried = minimizer(lambda _, state: None, step)(None, Curve(10.0, np.zeros(2)), damping, iterations)
    assert tried == len(used)
    return best.cost, tried, used


def test_damping_falls_after_a_gain_and_rises_after_none():
    cost, _, used = recorded([8, 9, 8, math.inf, math.nan, 4], Damping(), 6)
    assert cost == 4
    assert used == pytest.approx([1e-3 * factor for factor in (1, 1 / 4, 2, 16, 128, 1024)])


@pytest.mark.parametrize(
    ("options", "costs", "tried"),
    [
        ({}, [9, 8.9999, 7], 2),  # a gain of a hundred-thousandth
        ({"small_gains": 2}, [9, 8.9999, 8.9998, 7], 3),
        ({"small_gains": 2}, [9, 8.9999, 8, 7.9999, 7.9998, 7], 5),
        ({"most": 0.05}, [11, 11, 11], 2),
        ({"tries": 3}, [9, 11, 11, 11, 8], 4),
        ({}, [9, 8, 7, 6, 5, 4], 5),  # that many may be tried
        ({"tries": 3}, [9, 8, 7, 6, 11, 11, 5, 4], 7),  # and what was begun there is ended
    ],
)
def test_when_it_ends(options, costs, tried):
    assert recorded(costs, Damping(**options), 5)[1] == tried


def test_no_iterations_ask_for_nothing():
    start = at(np.zeros(2))
    best, tried = minimizer(None, None)(None, start, Damping(), 0)
    assert best is start and tried == 0


def test_unseen_parts_stay_still():
    matrices = np.stack([np.diag([4.0, 0.0]), np.zeros((2, 2))])
    assert np.allclose(damped(matrices, 0.5), [np.diag([6.0, 4e-9]), np.diag([4e-9, 4e-9])])
    assert np.linalg.solve(damped(np.zeros((2, 2)), 0.5), np.zeros(2)).tolist() == [0, 0]
