"""An object that is known before the video begins: its mesh and colours, and the unit that the solver sees it in."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel
from tracking3d.estimation.shape import RADIUS
from tracking3d.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class KnownObject:
    """An object that an earlier run, a scan or a drawing knows.

    Solvers have it with its middle at the origin and a radius of `tracking3d.estimation.shape.RADIUS`, since
    their tolerances are made for that; what they answer is turned back into the object's own coordinates and unit.
    """

    name: str  # what sentences call it
    model: ObjectModel  # in its own coordinates; texture_weight is 0 if its colours are not known
    camera: Camera | None = None  # the camera that it was learnt with; None if there was none

    @property
    def has_colours(self) -> bool:
        """Whether the colours of any of it are known."""
        return bool((self.model.texture_weight > 0).any())

    @cached_property
    def centre(self) -> NDArray[np.float64]:
        """``(3,)`` the middle of its bounding box."""
        vertices = self.model.vertices
        return np.asarray(0.5 * (vertices.min(0) + vertices.max(0)))

    @cached_property
    def scale(self) -> float:
        """The solver's units in one of the object's own."""
        return RADIUS / max(float(np.linalg.norm(self.model.vertices - self.centre, axis=1).max()), 1e-12)

    @cached_property
    def vertices(self) -> NDArray[np.float64]:
        """``(V, 3)`` as the solver has them."""
        return np.asarray(self.scale * (self.model.vertices - self.centre))

    def to_solver(self, T_cam_obj: NDArray[np.float64]) -> NDArray[np.float64]:
        """``(4, 4)`` the solver's pose for one of the object in its own coordinates."""
        T = T_cam_obj.copy()
        T[:3, 3] = self.scale * (T_cam_obj[:3, :3] @ self.centre + T_cam_obj[:3, 3])
        return T

    def from_solver(self, T_cam_obj: NDArray[np.float64]) -> NDArray[np.float64]:
        """The inverse of `to_solver`."""
        T = T_cam_obj.copy()
        T[:3, 3] = T_cam_obj[:3, 3] / self.scale - T_cam_obj[:3, :3] @ self.centre
        return T

    def answered(self, estimate: FrameEstimate) -> FrameEstimate:
        """A solver's estimate with the pose in the object's own coordinates."""
        earlier = tuple(self.answered(one) for one in estimate.revised)
        return replace(estimate, T_cam_obj=self.from_solver(estimate.T_cam_obj), revised=earlier)
