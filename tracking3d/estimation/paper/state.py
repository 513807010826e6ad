"""The paper solver's state: everything it knows between two frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.paper.problem import Parameters
from tracking3d.estimation.shape import Shape
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import BackProjection, TexelMap, back_project, project, rasterize


@dataclass(frozen=True, eq=False)
class PosedObservation:
    """A frame that stays in the optimization, with its pose as it stands."""

    observation: Observation
    pose: Pose


@dataclass(frozen=True, eq=False)
class PaperState:
    """What the solver knows."""

    camera: Camera  # the camera of the video
    shape: Shape  # the fixed part of the object
    texels: TexelMap  # where each texel lies on the surface
    offsets: Tensor  # (V, 3) vertex offsets from the prototype
    texture: Tensor  # (C, T, T) feature texture
    keyframes: tuple[PosedObservation, ...]  # in order of time
    seen: BackProjection  # RGB that former keyframes showed of each texel
    last: tuple[Pose, int]  # pose and index of the last frame, a lost one's included
    # the same of the frame before that one; None if there is no motion to go on with
    before: tuple[Pose, int] | None = None
    # first frames that wait for the joint start, with their answers so far; None when none waits any more
    waiting: tuple[tuple[PosedObservation, FrameEstimate], ...] | None = None
    started: bool = False  # whether the first frame is done
    space: FeatureSpace | None = None  # what is made of the encoder's features; None leaves them as they are
    renderer: str = "auto"  # which renderer, see `tracking3d.rendering.backend`

    @property
    def vertices(self) -> Tensor:
        """``(V, 3)`` in object coordinates."""
        return self.shape.rest + self.offsets

    @property
    def object_size(self) -> float:
        """Diameter of the object in object units."""
        centred = self.vertices - self.vertices.mean(0)
        return 2 * float(centred.norm(dim=1).max())

    def moved(self, pose: Pose, index: int) -> PaperState:
        """The same state one frame later."""
        return replace(self, last=(pose, index), before=self.last if self.started else None, started=True)

    def back_project(self, values: Tensor, keyframe: PosedObservation) -> BackProjection:
        """What a frame shows of the texture; ``values`` is ``(C, H, W)`` over the frame's window."""
        observation = keyframe.observation
        scale = values.shape[-1] / observation.window.size
        K = observation.K.clone()
        K[:2] *= scale
        K[:2, 2] += (scale - 1) / 2  # pixel centres stay at integers
        valid = observation.valid * (observation.mask if observation.has_mask else 1.0)
        valid = torch.nn.functional.interpolate(valid[None, None], size=values.shape[-2:], mode="bilinear")[
            0, 0
        ]
        return back_project(
            values, valid, self.vertices, self.shape.faces, self.texels, keyframe.pose.R,
            keyframe.pose.translation, K, self.renderer,
        )  # fmt: skip

    def visible_texture_of_keyframes(self) -> BackProjection:
        """RGB seen of each texel, the present keyframes included."""
        seen = self.seen
        for keyframe in self.keyframes:
            seen = seen + self.back_project(keyframe.observation.image, keyframe)
        return seen

    def silhouette(self, pose: Pose) -> NDArray[np.bool_]:
        """Hard silhouette ``(H, W)`` in the full frame."""
        size = (self.camera.height, self.camera.width)
        K = torch.tensor(self.camera.K, dtype=torch.float32, device=self.offsets.device)
        screen, depth = project(self.vertices, pose.R[None], pose.translation[None], K[None])
        covered = rasterize(screen, depth, self.shape.faces, size, self.renderer).face_index[0] >= 0
        return np.asarray(covered.cpu().numpy(), dtype=np.bool_)

    def parameters(self, frames: list[PosedObservation]) -> Parameters:
        """Poses of the frames, with the shape and texture as they are."""
        poses = Pose.stack([frame.pose for frame in frames])
        return Parameters(poses.translation, poses.quaternion, self.offsets, self.texture)
