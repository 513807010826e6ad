"""Surfaces of revolution: what changes them as a whole, and poses whose rotation about the axis is free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays

FloatArray = NDArray[np.float64]
_WAVES = 14  # cosines of the angle from the axis that describe a profile (measured: 8 do not follow a bottle's neck)
_RIDGE = 1e-6  # share of the mean square by which the profile's waves are damped (chosen)


@dataclass(frozen=True, eq=False)
class FreeAxis:
    """An axis about which an object looks the same from all sides, so that rotation about it is not known."""

    direction: FloatArray  # (3,) unit vector in object coordinates
    point: FloatArray  # (3,) where it passes through the object, in object coordinates

    def revolved(self, vertices: Tensor, faces: Tensor) -> Tensor:
        """``(V, 3)`` the surface of revolution near a surface: distances from the point are means over each latitude.

        Args:
            vertices: ``(V, 3)``.
            faces: ``(F, 3)``.
        """
        a, b, c = vertices[faces].double().unbind(1)
        area = torch.linalg.cross(b - a, c - a).norm(dim=1).repeat_interleave(3)
        weight = area.new_zeros(len(vertices)).index_add(0, faces.flatten(), area)[:, None]
        arm = vertices.double() - torch.from_numpy(self.point).to(vertices.device)
        length = arm.norm(dim=1, keepdim=True).clamp_min(1e-9)
        waves, *_ = self._latitude(vertices)
        stiffness = torch.arange(_WAVES, dtype=torch.float64, device=vertices.device).square()
        matrix = waves.T @ (weight * waves) + _RIDGE * weight.sum() * torch.diag(stiffness)
        profile = torch.linalg.solve(matrix, waves.T @ (weight * length))
        return (vertices.double() - arm + arm / length * (waves @ profile)).to(vertices)

    def basis(self, vertices: Tensor) -> tuple[ShapeBasis, Tensor]:
        """How the profile of a surface of revolution can change: N waves outwards, and N along the axis.

        Returns:
            A basis of ``6 N`` modes without bending, and ``(18 N, 2 N)`` what the profile's changes are in it.
        """
        waves, outwards, sine = self._latitude(vertices)
        along = torch.from_numpy(self.direction).to(waves)
        fields = [outwards * sine[:, None], along.expand_as(outwards)]
        moved = torch.cat([field[:, :, None] * waves[:, None] for field in fields], 2)  # (V, 3, 2 N)
        each = torch.eye(3).to(waves)[:, None, :, None] * torch.eye(moved.shape[2]).to(waves)[:, None]
        tied = each.flatten(0, 2)  # the x of a change is the x of the mode that holds its x
        return ShapeBasis(moved.flatten(1), waves.new_zeros(moved[0].numel())), tied

    def _latitude(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Waves ``(V, N)`` of vertices' angles from the axis, unit vectors away from it, and the angles' sines."""
        arm = vertices.double() - torch.from_numpy(self.point).to(vertices.device)
        along = torch.from_numpy(self.direction).to(arm)
        height = arm @ along
        across = arm - height[:, None] * along
        radius = across.norm(dim=1)
        angle = torch.atan2(radius, height)
        order = torch.arange(_WAVES, dtype=torch.float64, device=vertices.device)
        return torch.cos(angle[:, None] * order), across / radius.clamp_min(1e-9)[:, None], angle.sin()

    def untwisted(self, pose: Pose, before: Pose) -> Pose:
        """The same view of the object, turned about the axis as little as possible since an earlier pose.

        No other rotation about the axis is smoother over time, and a surface of revolution looks the same.
        """
        (R, t), (R_before, _) = pose_arrays(pose), pose_arrays(before)
        old, new = R_before @ self.direction, R @ self.direction
        sine, cosine = np.cross(old, new), float(old @ new)
        if cosine < 0:  # so large a turn has no one way
            return pose
        cross = np.array([[0, -sine[2], sine[1]], [sine[2], 0, -sine[0]], [-sine[1], sine[0], 0]])
        turned = (np.eye(3) + cross + cross @ cross / (1 + cosine)) @ R_before
        return pose_from_arrays(turned, R @ self.point + t - turned @ self.point, pose.translation)
