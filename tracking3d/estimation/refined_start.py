"""An earlier final refinement from which another one starts: poses and surface of the frames whose estimates stay."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera

_Pose = NDArray[np.float64]
LEAST_FRAMES = 4
"""Frames whose estimates stay; with fewer, nothing is known of how the refinement moved the object."""


@dataclass(frozen=True, eq=False)
class RefinedStart:
    """Poses and surface as a final refinement left them, to be continued with causal estimates of some other frames.

    The refinement may have rotated and scaled the object and changed the focal length; frames whose estimates stay have
    both poses, which tell how a causal pose is to be changed.
    """

    camera: Camera  # the camera of the refined poses
    vertices: NDArray[np.float64]  # (V, 3) the refined surface, with the topology of the solver's
    refined: Mapping[int, _Pose]  # (4, 4) refined poses by frame index, of at least `LEAST_FRAMES` frames
    causal: Mapping[int, _Pose]  # the same frames' causal poses
    focal: Mapping[int, float]  # the focal length in pixels that each causal pose belongs to

    @cached_property
    def scale(self) -> float:
        """Length of a causal unit in refined units."""
        depths = [
            (self.refined[index][2, 3], self.causal[index][2, 3] * self.camera.fx / self.focal[index])
            for index in self.refined
        ]
        return float(np.median([after / before for after, before in depths]))

    @cached_property
    def _indices(self) -> list[int]:
        return sorted(self.refined)

    def predict(self, index: int, T_cam_obj: _Pose, focal: float) -> _Pose:
        """The refined pose ``(4, 4)`` that a causal one amounts to: by the frame nearest in time.

        Args:
            index: Index of the frame.
            T_cam_obj: ``(4, 4)`` its causal pose.
            focal: The focal length in pixels that this belongs to.
        """
        if index in self.refined:
            return self.refined[index]
        after = bisect(self._indices, index)
        around = self._indices[max(after - 1, 0) : after + 1]
        nearest = min(around, key=lambda one: abs(one - index))
        there = self._scaled(self.causal[nearest], self.focal[nearest])
        return self._scaled(T_cam_obj, focal) @ np.linalg.inv(there) @ self.refined[nearest]

    def _scaled(self, T_cam_obj: _Pose, focal: float) -> _Pose:
        """A causal pose in refined units and with the refined focal length, under which the object keeps its size."""
        T = T_cam_obj.copy()
        T[:3, 3] *= self.scale
        T[2, 3] *= self.camera.fx / focal
        return T
