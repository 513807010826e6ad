"""The map of the object: its shape, texture, landmarks and keyframes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.optimization.revolution import FreeAxis
from tracking3d.estimation.shape import Shape, visible_texture
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.rendering import BackProjection, Surface, TexelMap, back_project, project
from tracking3d.rendering.visibility import nearest_depth
from tracking3d.scene.view import FrameCrop


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame with its pose and its landmark observations."""

    observation: Observation  # its window
    mask: NDArray[np.bool_] | None  # (H, W) initial mask in the full frame, or None
    pose: Pose  # the current pose
    points: FollowedPoints  # landmarks and their pixels in the frame
    # for matching; keypoint_landmark (M,) is the index of each one's landmark
    keypoints: Keypoints = field(default_factory=Keypoints.none)
    keypoint_landmark: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # the frame's back-projected feature texture, as last computed; None before
    texture: BackProjection | None = None
    mask_weight: float = 1.0  # how far the mask is trusted, in [0, 1]
    strength: float = math.inf  # texture strength inside the mask, if it was computed; see `texture_strength`
    # the image around the object, for dense landmarks; None if there is no mask
    image: FrameCrop | None = None
    # whether dense landmarks have adjusted the pose, so that local mapping keeps it
    is_adjusted: bool = False

    @property
    def index(self) -> int:
        """The frame's index in the source."""
        return self.observation.index


@dataclass(frozen=True, eq=False)
class ObjectMap:
    """The map of the object."""

    shape: Shape  # the topology and prototype, which never change
    texels: TexelMap  # where each texel lies on the surface
    vertices: Tensor  # (V, 3)
    landmarks: NDArray[np.float64]  # (N, 3) float64 surface points in object coordinates
    keyframes: tuple[Keyframe, ...]  # in order of time; the first one's pose is fixed
    # (N,) whether a landmark was found outside the mask and is not yet known to be on the object
    candidate: NDArray[np.bool_]
    # whether the object has no points that can be tracked: only pixels and outlines constrain it
    pointless: bool = False
    lead: float = math.nan  # of a finished map without points, see `lead_over_rivals`; NaN of other maps
    renderer: str = "auto"  # which renderer, see `tracking3d.rendering.backend`
    # (8, 2) candidate landmarks in each direction from the object: those that could be tested, and those that
    # move with it
    candidates_around: NDArray[np.int64] = field(default_factory=lambda: np.zeros((8, 2), np.int64))
    # How many of the first keyframes are rendered from an object that was known before. Its shape is fixed,
    # and its surface points count as seen often. 0 if the map is built from the video.
    fixed_keyframes: int = 0
    # whether the object was still when tracking began: until it has turned, the things next to it move in the
    # image as it does
    started_at_rest: bool = False
    # index of the newest keyframe when dense landmarks were last asked to refine the map; -1 if they never
    # were
    asked_landmarks: int = -1
    # of an object without points that is a surface of revolution; its surface is kept one. None if it has none
    free_axis: FreeAxis | None = None

    @cached_property
    def sightings(self) -> NDArray[np.int64]:
        """``(N,)`` how many keyframes show each landmark."""
        count = np.full(len(self.landmarks), int(self.fixed_keyframes > 0), np.int64)
        for view in self.keyframes:
            count[view.points.landmark] += 1
        return count

    @cached_property
    def landmark_scene(self) -> LandmarkScene:
        """Surface and keyframes for dense landmarks; see `tracking3d.estimation.online.mapping.keyframe_insertion`.

        Its views are drawn, and written here, when they are first needed: most never are, since each new keyframe makes
        another map.
        """
        vertices = self.vertices.detach().double().cpu().numpy()
        return LandmarkScene(
            [None] * len(self.keyframes), vertices, self.shape.faces.cpu().numpy().astype(np.int64)
        )

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the middle."""
        return float((self.vertices - self.vertices.mean(0)).norm(dim=1).max())

    def back_project(self, values: Tensor, view: Keyframe) -> BackProjection:
        """The view's texture back-projection; ``values`` is ``(C, H, W)`` over its window."""
        observation = view.observation
        scale = values.shape[-1] / observation.window.size
        K = observation.K.clone()
        K[:2] *= scale
        K[:2, 2] += (scale - 1) / 2  # pixel centres stay at integers
        valid = observation.valid * (observation.mask if observation.has_mask else 1.0)
        if scale != 1:
            valid = torch.nn.functional.interpolate(
                valid[None, None], size=values.shape[-2:], mode="bilinear"
            )[0, 0]
        return back_project(
            values, valid, self.vertices, self.shape.faces, self.texels, view.pose.R, view.pose.translation, K,
            self.renderer,
        )  # fmt: skip

    def with_textures(self, positions: Iterable[int] | None = None) -> ObjectMap:
        """The map with the textures of its keyframes back-projected again: of those at some positions, or of all."""
        keyframes = list(self.keyframes)
        for position in range(len(keyframes)) if positions is None else positions:
            view = keyframes[position]
            keyframes[position] = replace(view, texture=self.back_project(view.observation.features, view))
        return replace(self, keyframes=tuple(keyframes))

    def surface(self) -> Surface:
        """Shape and texture for fitting poses; the texture is the mean over the keyframes."""
        size = self.texels.size
        channels = self.keyframes[0].observation.features.shape[0]
        total = BackProjection(
            self.vertices.new_zeros(channels, size, size), self.vertices.new_zeros(size, size)
        )
        for view in self.keyframes:
            total = total + (view.texture or self.back_project(view.observation.features, view))
        texture = total.mean().permute(1, 2, 0).contiguous().permute(2, 0, 1)
        seen = (total.weight > 0).float()[None]
        return Surface(self.vertices, self.shape.faces, self.shape.face_uvs, texture, seen, self.renderer)

    def model(self, surface: Surface) -> ObjectModel:
        """The mesh with its visible texture back-projected from the keyframes; ``surface`` has the features."""
        size = self.texels.size
        seen = BackProjection(self.vertices.new_zeros(3, size, size), self.vertices.new_zeros(size, size))
        for view in self.keyframes:
            seen = seen + self.back_project(view.observation.image, view)
        texture, weight = visible_texture(seen)
        return ObjectModel(
            self.vertices.double().cpu().numpy(),
            self.shape.faces.cpu().numpy(),
            self.shape.face_uvs.double().cpu().numpy(),
            texture,
            weight,
            surface.texture.permute(1, 2, 0).cpu().numpy(),
        )

    def silhouette(self, pose: Pose, camera: Camera) -> NDArray[np.bool_]:
        """Hard silhouette ``(H, W)`` in the full frame."""
        size = (camera.height, camera.width)
        K = torch.tensor(camera.K, dtype=torch.float32, device=self.vertices.device)
        screen, depth = project(self.vertices, pose.R[None], pose.translation[None], K[None])
        drawn = nearest_depth(screen[0], depth[0], self.shape.faces, size, self.renderer)
        return np.isfinite(drawn.cpu().numpy())  # ten times as fast as torch's
