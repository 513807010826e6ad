"""The online solver's state: the object's map, and where it was seen last."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.judgement import Usual
from tracking3d.estimation.online.keypoints import Keypoints
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.shape import Shape
from tracking3d.evidence import Colours
from tracking3d.evidence.moving_along import Glimpse
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import BackProjection, Surface, TexelMap, back_project, project, rasterize


@dataclass(frozen=True, eq=False)
class View:
    """A frame with its pose and what it shows of the landmarks.

    Attributes:
        observation: Its window.
        mask: ``(H, W)`` initial mask in the full frame, or None.
        pose: As it stands.
        points: Landmarks and where the frame shows them.
        keypoints: For matching; ``keypoint_landmark`` ``(M,)`` says which landmark each is.
        texture: What the frame shows of the feature texture, as last computed; None before.
        mask_weight: How far the mask is believed, in [0, 1].
        strength: Of the texture inside the mask, as far as it was asked for; see `texture_strength`.
    """

    observation: Observation
    mask: NDArray[np.bool_] | None
    pose: Pose
    points: FollowedPoints
    keypoints: Keypoints = field(default_factory=Keypoints.none)
    keypoint_landmark: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    texture: BackProjection | None = None
    mask_weight: float = 1.0
    strength: float = math.inf

    @property
    def index(self) -> int:
        """The frame's index in the source."""
        return self.observation.index


@dataclass(frozen=True, eq=False)
class ObjectMap:
    """What is known of the object.

    Attributes:
        shape: The fixed part.
        texels: Where each texel lies on the surface.
        vertices: ``(V, 3)``.
        landmarks: ``(N, 3)`` float64 surface points in object coordinates.
        keyframes: In order of time; the first one's pose never moves.
        candidate: ``(N,)`` found beside the mask, and not yet known to be on the object.
        pointless: Whether the object has no points that can be followed: it is known by pixels and outlines alone.
        renderer: Which renderer, see `tracking3d.rendering.backend`.
        beside: ``(8, 2)`` candidates in each direction from the object that could be told, and that move as it does.
        held: How many of the first keyframes are drawn ones of an object that was known before, whose shape is held and
            of whose surface every point counts as often seen; 0 where the object is got to know in the video.
    """

    shape: Shape
    texels: TexelMap
    vertices: Tensor
    landmarks: NDArray[np.float64]
    keyframes: tuple[View, ...]
    candidate: NDArray[np.bool_]
    pointless: bool = False
    renderer: str = "auto"
    beside: NDArray[np.int64] = field(default_factory=lambda: np.zeros((8, 2), np.int64))
    held: int = 0

    @cached_property
    def sightings(self) -> NDArray[np.int64]:
        """``(N,)`` how many keyframes show each landmark."""
        count = np.full(len(self.landmarks), int(self.held > 0), np.int64)
        for view in self.keyframes:
            count[view.points.landmark] += 1
        return count

    @property
    def radius(self) -> float:
        """Largest distance of a vertex from the middle."""
        return float((self.vertices - self.vertices.mean(0)).norm(dim=1).max())

    def back_project(self, values: Tensor, view: View) -> BackProjection:
        """What a view shows of the texture; ``values`` is ``(C, H, W)`` over its window."""
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

    def surface(self) -> Surface:
        """Shape and texture for fitting poses; the texture is the mean of what the keyframes show."""
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

    def silhouette(self, pose: Pose, camera: Camera) -> NDArray[np.bool_]:
        """Hard silhouette ``(H, W)`` in the full frame."""
        size = (camera.height, camera.width)
        K = torch.tensor(camera.K, dtype=torch.float32, device=self.vertices.device)
        screen, depth = project(self.vertices, pose.R[None], pose.translation[None], K[None])
        covered = rasterize(screen, depth, self.shape.faces, size, self.renderer).face_index[0] >= 0
        return np.asarray(covered.cpu().numpy(), dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class Aside:
    """An inactive map; its transform to the active map is unknown.

    Attributes:
        known: The map.
        surface: The map's surface.
        usual: What frames that were tracked against it have cost.
        spans: First and last index of the frames that it answered.
        guessed: Whether how it lies to the first map is a guess.
    """

    known: ObjectMap
    surface: Surface
    usual: Usual
    spans: tuple[tuple[int, int], ...]
    guessed: bool


@dataclass(frozen=True, eq=False)
class Belief:
    """What the solver knows between two frames.

    Attributes:
        camera: The camera of the video.
        known: The object's map.
        surface: The map's surface, as poses are fitted to it.
        last: Pose and index of the last frame, a lost one's included.
        before: The same of the frame before; None where there is no motion to go on with.
        grey: ``(H, W)`` the last frame.
        followed: Points in the last frame.
        waiting: First frames that wait for the start, with their answers so far; None once it is done.
        space: What is made of the encoder's features; None leaves them as they are.
        due: Motion at which the next start is tried.
        undecided: How many frames the last start had that could not be told from another; 0 if there was none.
        leaning: ``(3,)`` how the object turns in that start, as a rotation vector; None if there was none.
        waits_for: Why the start waits, where that is not lack of motion.
        usual: What tracked frames have cost.
        lost_for: How many frames in a row the object has been lost; those without a mask, where nothing can be tried,
            count as one.
        doubted_for: How many frames in a row have been lost or hardly believed.
        tried: The best pose of the last frame, where that had a mask and was not believed.
        trail: Poses and indices of the last frames that were believed.
        colours: Of object and surroundings in frames that were believed.
        past: The last frames that were believed, for what moves along.
        anew: A second start, under way while the object is lost and there is a mask; see `anew`.
        aside: Other maps of the object.
        spans: First and last index of earlier frames that the present map answered; since: from which index it does.
        guessed: Whether how it lies to the first map is a guess.
        reversal_tried: How many keyframes there were, and how many degrees they had turned, when depth was last tried
            the other way round.
    """

    camera: Camera
    known: ObjectMap
    surface: Surface | None
    last: tuple[Pose, int]
    before: tuple[Pose, int] | None
    grey: NDArray[np.uint8]
    followed: FollowedPoints
    waiting: tuple[tuple[View, FrameEstimate], ...] | None = ()
    space: FeatureSpace | None = None
    due: float = 0.0
    undecided: int = 0
    leaning: NDArray[np.float64] | None = None
    waits_for: str = ""
    usual: Usual = field(default_factory=Usual)
    lost_for: int = 0
    doubted_for: int = 0
    tried: Pose | None = None
    trail: tuple[tuple[Pose, int], ...] = ()
    colours: Colours | None = None
    past: tuple[Glimpse, ...] = ()
    anew: Belief | None = None
    aside: tuple[Aside, ...] = ()
    spans: tuple[tuple[int, int], ...] = ()
    since: int = -1
    guessed: bool = False
    reversal_tried: tuple[int, float] = (0, 0.0)

    def moved(self, pose: Pose, index: int, grey: NDArray[np.uint8], followed: FollowedPoints) -> Belief:
        """One frame later."""
        return replace(self, last=(pose, index), before=self.last, grey=grey, followed=followed)


ONLINE_CLASSES = (Aside, Belief, Colours, Glimpse, ObjectMap, View, Surface, FollowedPoints, Keypoints, Usual)
"""What a `Belief` is made of beside `tracking3d.estimation.solver.STATE_CLASSES`."""
