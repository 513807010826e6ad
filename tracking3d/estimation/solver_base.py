"""What the solvers have in common: configuration, camera and encoder, and how a frame becomes an observation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation, mask_box, observe, projected_box
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose


@dataclass(frozen=True)
class SolverBase:
    """The fields that every solver has."""

    config: PipelineConfig  # the pipeline's configuration
    camera: Camera  # the camera of the full frame
    encoder: FeatureEncoder  # the feature encoder

    @property
    def device(self) -> torch.device:
        """The device of all tensors."""
        return torch.device(self.config.runtime.device)

    def observe(
        self,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        pose: Pose,
        vertices: torch.Tensor,
        camera: Camera,
        space: FeatureSpace | None,
    ) -> Observation:
        """Crop a frame around the object and encode the crop.

        Args:
            frame: The frame.
            mask: Mask of the object ``(H, W)``, around which the frame is cropped; None if there is none.
            pose: Expected pose; without a mask the frame is cropped around the object there.
            vertices: Vertices of the object ``(V, 3)``.
            camera: Camera of the frame.
            space: Subspace that features are projected into, if they are.
        """
        box = mask_box(mask) if mask is not None else projected_box(vertices, camera, pose)
        if box is None:
            box = (0.0, 0.0, float(camera.width), float(camera.height))
        window = Window.around(box, self.config.crop.margin, self.config.crop.size)
        observation = observe(frame, mask, window, camera, self.encoder, self.device)
        if space is None:
            return observation
        return replace(observation, features=space.project(observation.features, observation.image))
