"""The map of an object that is known before the video begins, rendered from all sides.

Every rendered side becomes a keyframe whose keypoints are points of the surface; from then on the object is tracked
like any other, except that its shape is fixed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.known_object import KnownObject
from tracking3d.estimation.observation import Observation, crop, mask_box, observe
from tracking3d.estimation.online.features.klt import FollowedPoints, grey
from tracking3d.estimation.online.features.sift import detect
from tracking3d.estimation.online.mapping.local_mapping import with_landmarks
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.shape import RADIUS, Shape
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.pose import Pose, pose_from_arrays
from tracking3d.rendering import BackProjection, TexelMap, back_project, project, rasterize
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.texture import sample_texture

SIDES = 42
"""Directions that the object is drawn from: neighbours are about 33 degrees apart, so no view of it is farther than
about 20 from one of them, which keypoints bridge."""
_PICTURE = 320  # pixels
_SUPERSAMPLING = 2  # times, for drawing, so that nothing is jagged
_FIELD_OF_VIEW = 30.0
_FILLED = 0.85  # of the picture, by the sphere around the object
_MAX_TEXELS = 1024  # along a side of the texture that is drawn
_MARGIN = 3  # pixels that keypoints stay away from what was never seen
_TEXTURE_WEIGHT = 3.0  # weight of the known texture, in views of the new video that show it head-on
_FINEST_TEXELS, _TEXELS_OF_A_FACE = 512, 4.0


@dataclass(frozen=True, eq=False)
class RenderedSide:
    """One side of an object, drawn."""

    image: NDArray[np.uint8]  # (S, S, 3) uint8
    mask: NDArray[np.bool_]  # (S, S) its silhouette; known: where its colours are known
    known: NDArray[np.bool_]
    # (S, S, 3) surface points in object coordinates, at the pixels' centres; NaN in the background
    points: NDArray[np.float32]


def map_of_known_object(
    known: KnownObject, config: PipelineConfig, encoder: FeatureEncoder, device: torch.device
) -> tuple[ObjectMap, FeatureSpace | None]:
    """The map and the feature space; None for the latter if no known colours determine it.

    Args:
        known: The object.
        config: The pipeline.
        encoder: The feature encoder.
        device: Where tensors live.
    """
    model, renderer = known.model, config.runtime.renderer
    shape = Shape.of(Mesh(known.vertices, model.faces, model.face_uvs), False, device)
    texels = TexelMap.of(shape.face_uvs, _texels(config.object.texture_size, len(model.faces)))
    learnt = ObjectMap(
        shape,
        texels,
        shape.rest,
        np.zeros((0, 3)),
        (),
        np.zeros(0, bool),
        renderer=renderer,
    )
    camera = Camera.from_fov(_PICTURE, _PICTURE, _FIELD_OF_VIEW)
    distance = RADIUS / math.sin(_FILLED * math.radians(_FIELD_OF_VIEW) / 2)
    colours = _colours(known).to(device)
    seen: list[tuple[Keyframe, RenderedSide]] = []
    for number, R in enumerate(sides(SIDES)):
        pose = pose_from_arrays(R, np.array([0.0, 0.0, distance]), shape.rest)
        drawing = render_side(shape, colours, pose, camera, renderer)
        if not drawing.mask.any():
            continue  # a flat thing, from its edge
        # Drawn sides come before the first frame.
        frame = Frame(number - SIDES, drawing.image)
        window = Window.around(mask_box(drawing.mask), config.crop.margin, config.crop.size)
        observation = observe(frame, drawing.mask, window, camera, encoder, device)
        view = Keyframe(observation, drawing.mask, pose, FollowedPoints.none())
        learnt, view = _with_points(learnt, camera, view, drawing)
        learnt = replace(learnt, keyframes=(*learnt.keyframes, view))
        seen.append((view, drawing))
    channels = feature_channels(encoder, config.object.texture_channels)
    space = _space(seen, channels) if known.has_colours else None
    texture = _texture(learnt, seen, space, channels)
    nothing = BackProjection(torch.zeros_like(texture.total), torch.zeros_like(texture.weight))
    keyframes = tuple(
        replace(
            view,
            observation=_without_pixels(view.observation, channels),
            mask=None,
            texture=nothing if number else texture,
        )
        for number, view in enumerate(learnt.keyframes)
    )
    return replace(learnt, keyframes=keyframes, fixed_keyframes=len(keyframes)), space


def sides(count: int) -> list[NDArray[np.float64]]:
    """Rotations ``(3, 3)``, object to camera, that show an object from so many directions, evenly over the sphere."""
    turn = math.pi * (3 - math.sqrt(5))  # the golden angle: a Fibonacci lattice
    rotations = []
    for number in range(count):
        up = 1 - 2 * (number + 0.5) / count
        ring = math.sqrt(1 - up**2)
        forward = np.array([ring * math.cos(turn * number), up, ring * math.sin(turn * number)])
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        rotations.append(np.stack([right, np.cross(forward, right), forward]))
    return rotations


@torch.no_grad()
def render_side(
    shape: Shape, colours: Tensor, pose: Pose, camera: Camera, renderer: str = "auto"
) -> RenderedSide:
    """Draw an object before a background of its mean colour, which puts no edge of its own along the outline.

    Args:
        shape: The object.
        colours: ``(4, T, T)`` RGB in [0, 1], and 1 where it is known, else 0.
        pose: The pose of the object.
        camera: Square.
        renderer: See `tracking3d.rendering.backend`.
    """
    size = _SUPERSAMPLING * camera.width
    fine = (
        _SUPERSAMPLING * camera.fx,
        (camera.cx + 0.5) * _SUPERSAMPLING - 0.5,
        (camera.cy + 0.5) * _SUPERSAMPLING - 0.5,
    )
    K = colours.new_tensor([[fine[0], 0, fine[1]], [0, fine[0], fine[2]], [0, 0, 1]])
    screen, depth = project(shape.rest, pose.R[None], pose.translation[None], K[None])
    face_index = rasterize(screen, depth, shape.faces, (size, size), renderer).face_index
    corners = torch.cat([shape.face_uvs, shape.rest[shape.faces]], 2)
    at = interpolate(screen, depth, shape.faces, corners, face_index, renderer)
    layers = sample_texture(colours, at[:, :2])
    object_map = layers[:, 3:] > 0.5
    mean = (layers[:, :3] * object_map).sum(0) / object_map.sum().clamp_min(1)
    covered = (face_index[0] >= 0).cpu().numpy()
    picture = np.empty((size, size, 3), np.float32)
    picture[:] = mean.cpu().numpy()
    picture[covered] = (
        torch.where(object_map, layers[:, :3] / layers[:, 3:].clamp_min(1e-6), mean).cpu().numpy()
    )
    seen = np.zeros((size, size), np.float32)
    seen[covered] = object_map[:, 0].float().cpu().numpy()
    points = np.full((size, size, 3), np.nan, np.float32)
    points[covered] = at[:, 2:].cpu().numpy()

    def reduced(values: NDArray[np.float32]) -> NDArray[np.float32]:
        side = camera.width, camera.height
        return np.asarray(cv2.resize(values, side, interpolation=cv2.INTER_AREA), dtype=np.float32)

    # The centre of a pixel is where four finer ones meet; none of them may lie beside the object.
    corners_of = [
        points[row::_SUPERSAMPLING, column::_SUPERSAMPLING]
        for row in range(_SUPERSAMPLING)
        for column in range(_SUPERSAMPLING)
    ]
    return RenderedSide(
        (255 * reduced(picture)).round().clip(0, 255).astype(np.uint8),
        reduced(covered.astype(np.float32)) > 0.5,
        reduced(seen) > 0.99,
        np.mean(corners_of, axis=0, dtype=np.float32),
    )


def _with_points(
    learnt: ObjectMap, camera: Camera, view: Keyframe, drawing: RenderedSide
) -> tuple[ObjectMap, Keyframe]:
    """With landmarks at a drawn side's keypoints, exactly on the surface."""
    kernel = np.ones((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.uint8)
    inside = cv2.erode((drawing.known & drawing.mask).astype(np.uint8), kernel) > 0
    keypoints = detect(grey(drawing.image), inside)
    before = len(learnt.landmarks)
    learnt, view = with_landmarks(learnt, camera, view, keypoints, np.zeros((0, 2), np.float32))
    fresh = view.points.landmark >= before
    landmarks, pixel = learnt.landmarks.copy(), view.points.pixel[fresh]
    exact = _sample_surface(drawing.points, pixel)
    sound = np.isfinite(exact).all(1)
    landmarks[view.points.landmark[fresh][sound]] = exact[sound]
    return replace(learnt, landmarks=landmarks), view


def _sample_surface(points: NDArray[np.float32], pixel: NDArray[np.float32]) -> NDArray[np.float64]:
    """``(N, 3)`` of ``points`` ``(S, S, 3)`` between four pixels; nan if one of those is."""
    low = np.floor(pixel).astype(int).clip(0, len(points) - 2)
    (x, y), (right, down) = low.T, (pixel - low).T[..., None]
    upper = (1 - right) * points[y, x] + right * points[y, x + 1]
    lower = (1 - right) * points[y + 1, x] + right * points[y + 1, x + 1]
    return np.asarray((1 - down) * upper + down * lower)


def _colours(object_map: KnownObject) -> Tensor:
    """``(4, T, T)`` see `render_side`; no finer than pictures show them, with nothing mixed in that was never seen."""
    texture = object_map.model.texture.astype(np.float32) / 255
    seen = (object_map.model.texture_weight > 0).astype(np.float32)
    layers = np.concatenate([texture * seen[..., None], seen[..., None]], 2)
    height, width = seen.shape
    shrink = _MAX_TEXELS / max(height, width)
    if shrink < 1:
        size = max(round(shrink * width), 1), max(round(shrink * height), 1)
        layers = cv2.resize(layers, size, interpolation=cv2.INTER_AREA)
    return torch.from_numpy(np.ascontiguousarray(layers.transpose(2, 0, 1)))


def _texels(size: int, faces: int) -> int:
    """Texels along a side of the feature texture: more where an atlas of single faces would else blur them."""
    return max(size, min(round(_TEXELS_OF_A_FACE * math.sqrt(faces / 2)), _FINEST_TEXELS))


def _space(seen: list[tuple[Keyframe, RenderedSide]], channels: int) -> FeatureSpace:
    """The main components of the object's features over all its sides."""
    features = torch.cat([view.observation.features for view, _ in seen], 2)
    mask = torch.cat([_trusted_texture(view, drawing) for view, drawing in seen], 1)
    return FeatureSpace.of(features, mask, channels)


def _trusted_texture(view: Keyframe, drawing: RenderedSide) -> Tensor:
    """``(S, S)`` the part of a drawn side's window in which the colours are known."""
    known = torch.from_numpy(drawing.known).to(view.observation.mask)
    return (crop(known[None], view.observation.window)[0] > 0.99).float() * view.observation.mask


def _texture(
    learnt: ObjectMap, seen: list[tuple[Keyframe, RenderedSide]], space: FeatureSpace | None, channels: int
) -> BackProjection:
    """What all sides together show of the feature texture, counted as a few views."""
    size, rest = learnt.texels.size, learnt.vertices
    total = BackProjection(rest.new_zeros(channels, size, size), rest.new_zeros(size, size))
    if space is None:
        return total
    for view, drawing in seen:
        observation = view.observation
        total = total + back_project(
            space.project(observation.features), _trusted_texture(view, drawing), rest, learnt.shape.faces,
            learnt.texels, view.pose.R, view.pose.translation, observation.K, learnt.renderer,
        )  # fmt: skip
    counted = _TEXTURE_WEIGHT * (total.weight > 0)
    return BackProjection(total.mean() * counted, counted)


def _without_pixels(observation: Observation, channels: int) -> Observation:
    """What is left of a drawn side once its texture and its points are taken: no state need keep its pixels."""
    point = observation.valid.new_zeros(1, 1)
    return replace(
        observation, image=point.expand(3, 1, 1).clone(), features=point.new_zeros(channels, 1, 1), valid=point,
        mask=point, distance=point, has_mask=False,
    )  # fmt: skip
