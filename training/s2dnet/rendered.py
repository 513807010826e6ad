"""True correspondences under rotation and moving light, from this project's own synthetic sequences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pairs import SHIFT, Pair
from photometry import disturb
from tracking3d_bench.synthesis.camera_effects import linear
from tracking3d_bench.synthesis.frame_rendering import RenderedFrame, render_frame
from tracking3d_bench.synthesis.scene import make_scene
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec

Array = NDArray[np.float64]

FIRST_SEED = 50_000
"""The suites' sequences have seeds below 1000: no object of theirs is seen in training."""

_FRAMES = (0, 3, 6, 10, 14)
_SAME_DEPTH = 0.01  # relative difference up to which a point is taken to be seen, not hidden

OBJECTS = ("blob", "bottle", "box", "card", "mug", "vase", "wedge")
"""What pairs show; fixed, so that a training gives the same network whatever objects there are beside them."""


@dataclass(frozen=True, eq=False)
class RenderedObject:
    """A few frames of one object.

    Attributes:
        frames: Images and depths.
        T_cam_obj: ``(F, 4, 4)`` poses.
        K: ``(3, 3)`` intrinsics.
    """

    frames: list[RenderedFrame]
    T_cam_obj: Array
    K: Array


def render_objects(count: int, size: int, photographs: Sequence[NDArray[np.uint8]]) -> list[RenderedObject]:
    """Render ``count`` objects, every other one with a photograph for a texture, all before photographs."""
    return [_render(index, size, photographs) for index in range(count)]


def _render(index: int, size: int, photographs: Sequence[NDArray[np.uint8]]) -> RenderedObject:
    rng = np.random.default_rng([FIRST_SEED, index])
    spec = SequenceSpec(
        object=OBJECTS[index % len(OBJECTS)],
        motion="tumble",
        degrees_per_frame=float(rng.uniform(2, 5)),
        frames=max(_FRAMES) + 1,
        size=(size, size),
        fill=float(rng.uniform(0.6, 0.9)),
        disturbances=Disturbances(light=1.0, highlights=float(rng.uniform(0, 1))),
        seed=FIRST_SEED + index,
    )
    scene = make_scene(spec)
    scene = replace(scene, background=linear(_patch(photographs, (size, size), rng)))
    if index % 2 and scene.texture is not None:
        height, width = scene.texture.shape[:2]
        scene = replace(scene, texture=linear(_patch(photographs, (width, height), rng)))
    frames = [render_frame(scene, frame) for frame in _FRAMES]
    return RenderedObject(frames, scene.T_cam_obj[list(_FRAMES)], scene.camera.K)


def _patch(
    photographs: Sequence[NDArray[np.uint8]], size: tuple[int, int], rng: np.random.Generator
) -> NDArray[np.uint8]:
    photograph = photographs[rng.integers(len(photographs))]
    side = int(rng.uniform(0.4, 1.0) * min(photograph.shape[:2]))
    top, left = (int(rng.integers(0, extent - side + 1)) for extent in photograph.shape[:2])
    return cv2.resize(photograph[top : top + side, left : left + side], size, interpolation=cv2.INTER_AREA)


def rendered_pair(item: RenderedObject, count: int, rng: np.random.Generator, strength: float) -> Pair:
    """Two frames of an object and up to ``count`` surface points that are seen in both."""
    one, two = (int(frame) for frame in rng.choice(len(item.frames), 2, replace=False))
    rows, columns = np.nonzero(item.frames[one].visible_mask)
    chosen = rng.permutation(len(rows))[: 3 * count]
    pixels = np.stack([columns[chosen], rows[chosen]], 1)
    target, seen = follow(item, one, two, pixels)
    seen[np.cumsum(seen) > count] = False
    size = item.frames[one].depth.shape[0]
    shift = np.rint(rng.uniform(-SHIFT, SHIFT, 2) * size)
    moved = target + shift
    seen &= ((moved > 2) & (moved < size - 3)).all(1)
    move = np.float32([[1, 0, shift[0]], [0, 1, shift[1]]])
    second = cv2.warpAffine(item.frames[two].image, move, (size, size), borderMode=cv2.BORDER_REFLECT)
    images = (
        disturb(item.frames[one].image, rng, 0.3 * strength),
        disturb(second, rng, 0.5 * strength),
    )
    points = pixels[seen].astype(np.float32), moved[seen].astype(np.float32)
    return Pair(images, points, -1, np.zeros(0, np.int64))


def follow(
    item: RenderedObject, one: int, two: int, pixels: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_]]:
    """Where the surface points at ``pixels`` ``(N, 2)`` of frame ``one`` are in frame ``two``, and if they are seen."""
    first, second = item.frames[one], item.frames[two]
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(item.K).T
    T = item.T_cam_obj[two] @ np.linalg.inv(item.T_cam_obj[one])
    moved = rays * first.depth[pixels[:, 1], pixels[:, 0], None] @ T[:3, :3].T + T[:3, 3]
    projected = moved @ item.K.T
    target = projected[:, :2] / projected[:, 2:]
    size = first.depth.shape[0]
    columns, rows = np.clip(np.rint(target), 0, size - 1).astype(int).T
    seen = ((target > 2) & (target < size - 3)).all(1) & second.visible_mask[rows, columns]
    return target, seen & (np.abs(second.depth[rows, columns] / moved[:, 2] - 1) < _SAME_DEPTH)
