"""How firmly a frame holds a pose against turning, and about which axis it holds it least."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.pose_refinement_types import PoseFit

TURN = 10.0
"""Degrees of the turn whose cost is told."""


def least_held(fit: PoseFit) -> tuple[float, NDArray[np.float64]]:
    """What turning the object costs about the axis that is held least, and that axis ``(3,)`` in the camera's axes.

    By the normal equations: the object may move as it likes to make up for the turn. A solid of revolution without
    texture turns about its axis for nothing, whatever its outline says of the rest.

    Returns:
        The cost of `TURN` degrees, in units of `PoseFit.cost`; 0 where nothing holds it.
    """
    information = fit.information.double().cpu().numpy()
    moves, coupling, turns = information[:3, :3], information[:3, 3:], information[3:, 3:]
    floor = 1e-9 * max(float(np.trace(moves)), 1e-12)
    held = turns - coupling.T @ np.linalg.solve(moves + floor * np.eye(3), coupling)
    if not np.isfinite(held).all():
        return 0.0, np.array([0.0, 0.0, 1.0])
    values, axes = np.linalg.eigh((held + held.T) / 2)
    return max(float(values[0]), 0.0) * math.radians(TURN) ** 2 / 2, axes[:, 0]
