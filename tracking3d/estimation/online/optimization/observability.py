"""How well a frame constrains a pose's rotation, and about which axis it does so least."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.optimization.types import PoseFit

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
