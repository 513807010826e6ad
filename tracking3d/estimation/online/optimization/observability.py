"""How well a frame constrains a pose's rotation, and about which axis it does so least."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.optimization.types import PoseFit

TURN = 10.0
"""Degrees of the rotation whose cost is computed."""


def least_constrained_axis(
    fit: PoseFit, free: NDArray[np.float64] | None = None
) -> tuple[float, NDArray[np.float64]]:
    """The cost of rotating the object about its least constrained axis, and that axis ``(3,)`` in camera axes.

    By the normal equations: translation and the other rotations may compensate. A solid of revolution without texture
    rotates about its axis at no cost, whatever its outline says otherwise.

    Args:
        fit: The pose.
        free: ``(3,)`` an axis in object coordinates about which any rotation is as good; it is left out.

    Returns:
        The cost of a rotation by `TURN` degrees, in units of `PoseFit.cost`; 0 if nothing constrains it.
    """
    information = fit.information.double().cpu().numpy()
    moves, coupling, turns = information[:3, :3], information[:3, 3:], information[3:, 3:]
    floor = 1e-9 * max(float(np.trace(moves)), 1e-12)
    held = turns - coupling.T @ np.linalg.solve(moves + floor * np.eye(3), coupling)
    if not np.isfinite(held).all():
        return 0.0, np.array([0.0, 0.0, 1.0])
    if free is not None:  # it may compensate too
        along = fit.pose.R.double().cpu().numpy().reshape(3, 3) @ free
        held = held - np.outer(held @ along, along @ held) / max(float(along @ held @ along), floor)
        across = np.eye(3) - np.outer(along, along)
        held = across @ held @ across
    values, axes = np.linalg.eigh((held + held.T) / 2)
    least = 0 if free is None else 1
    return max(float(values[least]), 0.0) * math.radians(TURN) ** 2 / 2, axes[:, least]
