"""Rigid transforms and the axis conventions of other tools.

Ours are OpenCV's: x right, y down, z forward. OpenGL, glTF, USD, Nuke and nerfstudio have x right, y up, z backward,
which is half a turn about x.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""``(4, 4)`` from OpenCV's axes to OpenGL's, and back."""


def inverse(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of a rigid transform ``(4, 4)``."""
    inverted = np.eye(4)
    inverted[:3, :3] = T[:3, :3].T
    inverted[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverted


def quaternion(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation of a rigid transform ``(4, 4)`` as a unit quaternion ``(4,)`` w, x, y, z with w >= 0."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return np.array([w, x, y, z])


def continuous(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions ``(N, 4)`` with signs such that neighbours are on one side, as tools that interpolate need them."""
    turned = np.sign((quaternions[1:] * quaternions[:-1]).sum(1, keepdims=True))
    signs = np.cumprod(np.where(turned == 0, 1.0, turned), axis=0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs])
