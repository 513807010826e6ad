"""Short clips with exact ground truth: a textured convex object turns and drifts in front of a cluttered background.

OpenCV axes; pixel (0, 0) is the centre of the top-left pixel; ``x_cam = R x_obj + t``. A pixel belongs to the
mask if the ray through its centre meets the object. One `SyntheticSpec` always gives the same clip.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.frames import Box
from tracking3d.geometry.camera import DEFAULT_FIELD_OF_VIEW, Camera
from tracking3d.results.files import write_atomic, write_image, write_mask, writing
from tracking3d.runtime.progress import report_each
from tracking3d.testing.synthesis.convex_raycast import ConvexSurface, Ellipsoid, Polyhedron
from tracking3d.testing.synthesis.procedural_texture import (
    FloatImage,
    paint_background,
    paint_panel,
    sample_panels,
)

POSE_CONVENTION = "T_cam_obj: x_cam = R x_obj + t; OpenCV axes"

SURFACES: dict[str, ConvexSurface] = {
    "box": Polyhedron.box((0.62, 0.48, 0.56)),
    "chamfered_box": Polyhedron.box((0.62, 0.48, 0.56), chamfer=0.25),
    "ellipsoid": Ellipsoid(np.array([0.95, 0.7, 0.6])),
}
"""The objects by name, 0.95 in radius; their axes differ, so that fewer turns map one to itself."""


@dataclass(frozen=True)
class SyntheticSpec:
    """What to synthesize."""

    # box; chamfered_box, whose corners are cut off; or ellipsoid
    shape: Literal["box", "chamfered_box", "ellipsoid"] = "chamfered_box"
    frames: int = 20  # number of frames
    size: tuple[int, int] = (200, 160)  # (width, height) in pixels
    degrees_per_frame: float = 2.0  # rotation from each frame to the next
    # axis of that rotation in camera axes, of any length
    axis: tuple[float, float, float] = (-0.3, 1.0, -0.15)
    # movement in x, y and z from the first frame to the last, in object radii
    drift: tuple[float, float, float] = (0.4, -0.2, 0.4)
    # diameter of the object's enclosing sphere in the first frame relative to the image height
    fill: float = 0.6
    fov: float = DEFAULT_FIELD_OF_VIEW  # vertical field of view in degrees
    clutter: float = 1.0  # 0 for a plain background to 1 for a full one
    noise: float = 2.0  # standard deviation of the image noise in grey levels
    supersample: int = 3  # rays per pixel and axis; odd, so that one goes through the pixel's centre
    seed: int = 0  # seed of textures, background and noise


@dataclass(frozen=True, eq=False)
class SyntheticClip:
    """Images and their truth."""

    images: NDArray[np.uint8]  # (N, H, W, 3) uint8 RGB
    masks: NDArray[np.bool_]  # (N, H, W) bool
    T_cam_obj: NDArray[np.float64]  # (N, 4, 4) float64
    camera: Camera  # the camera of all frames
    surface: ConvexSurface  # the object, in object coordinates

    @property
    def K(self) -> NDArray[np.float64]:
        """``(3, 3)`` intrinsic matrix."""
        return self.camera.K

    @property
    def box(self) -> Box:
        """Bounding box ``(x, y, width, height)`` of the first mask."""
        x, y, width, height = (float(side) for side in cv2.boundingRect(self.masks[0].astype(np.uint8)))
        return x, y, width, height


def synthesize(spec: SyntheticSpec) -> SyntheticClip:
    """Make a clip in memory.

    Raises:
        ValueError: If ``spec.supersample`` is even or there are no frames.
    """
    if spec.supersample % 2 == 0 or spec.frames < 1:
        raise ValueError("supersample must be odd and frames at least 1")
    width, height = spec.size
    rng = np.random.default_rng(spec.seed)
    camera = Camera.from_fov(width, height, spec.fov, origin="synthetic")
    surface = SURFACES[spec.shape]
    panels = np.stack([paint_panel(rng) for _ in range(surface.panels)])
    background = paint_background(rng, width, height, spec.clutter)
    poses = _poses(spec, camera, surface.radius)
    images = np.empty((spec.frames, height, width, 3), np.uint8)
    masks = np.empty((spec.frames, height, width), bool)
    for n, pose in enumerate(report_each("drawing the clip", poses)):
        image, masks[n] = draw_convex(pose, camera, surface, panels, background, spec.supersample)
        noisy = image + spec.noise * rng.standard_normal(image.shape, dtype=np.float32)
        images[n] = np.clip(noisy.round(), 0, 255).astype(np.uint8)
    return SyntheticClip(images, masks, poses, camera, surface)


def degrade_masks(masks: NDArray[np.bool_], seed: int, pixels: float = 1.5) -> NDArray[np.bool_]:
    """Move the boundaries of ``masks`` ``(N, H, W)`` in and out at random, independently in every frame.

    The displacement is zero on average, has a standard deviation of ``pixels`` and varies smoothly along the
    boundary, over about four times as far. Empty and full masks stay as they are.
    """
    rng = np.random.default_rng(seed)
    degraded = masks.copy()
    for n, mask in enumerate(masks):
        if mask.all() or not mask.any() or pixels == 0:
            continue
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
        # Pixel centres next to the boundary are half a pixel away from it, not one.
        signed = np.where(mask, inside - 0.5, 0.5 - outside)
        shift = cv2.GaussianBlur(rng.standard_normal(mask.shape), (0, 0), 4 * pixels)
        degraded[n] = signed + pixels * shift / shift.std() > 0
    return degraded


def make_demo_clip(
    folder: Path, *, seed: int = 0, frames: int = 36, size: tuple[int, int] = (320, 240)
) -> Path:
    """Write the clip of ``tracking3d demo`` with its truth.

    Besides the exact ``masks/`` it holds ``rough_masks/``, the same with noise on their boundaries.

    Args:
        folder: Where to write; made if absent.
        seed: Seed of textures, background and noise.
        frames: Number of frames; the object turns by 2 degrees a frame, 70 degrees with the default.
        size: ``(width, height)`` in pixels.

    Returns:
        The folder.

    Raises:
        OutputError: If it cannot be written.
    """
    spec = SyntheticSpec(frames=frames, size=size, seed=seed, degrees_per_frame=2.0)
    clip = synthesize(spec)
    note = f"{spec.shape}, {spec.degrees_per_frame:g} degrees a frame, seed {seed}; the truth is exact"
    write_clip(folder, clip.images, clip.masks, clip.T_cam_obj, clip.camera, source="synthetic", note=note)
    rough = folder / "rough_masks"
    with writing(rough):
        rough.mkdir(exist_ok=True)
    for n, mask in enumerate(degrade_masks(clip.masks, seed)):
        write_mask(rough / f"{n:06d}.png", mask)
    return folder


def write_clip(
    folder: Path,
    images: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    T_cam_obj: NDArray[np.float64],
    camera: Camera,
    *,
    source: str,
    note: str,
) -> None:
    """Write a clip in full, frames as PNG.

    Args:
        folder: Made if absent; files of the same names are overwritten.
        images: ``(N, H, W, 3)`` uint8 RGB.
        masks: ``(N, H, W)`` bool.
        T_cam_obj: ``(N, 4, 4)``.
        camera: The camera of all frames.
        source: Where the clip comes from.
        note: Anything worth knowing.

    Raises:
        OutputError: If it cannot be written.
    """
    names = [f"{n:06d}" for n in range(len(images))]
    poses = {
        name: {"R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist(), "trusted": True}
        for name, pose in zip(names, T_cam_obj, strict=True)
    }
    box = list(cv2.boundingRect(masks[0].astype(np.uint8)))
    documents = {
        "poses.json": {"convention": POSE_CONVENTION, "units": "object radii, about", "frames": poses},
        "camera.json": {"K": camera.K.tolist(), "width": camera.width, "height": camera.height},
        "init.json": {"frame": 0, "bbox_xywh": box, "mask": f"masks/{names[0]}.png"},
        "info.json": {"source": source, "frames": len(images), "note": note},
    }
    for part in ("frames", "masks"):
        with writing(folder / part):
            (folder / part).mkdir(parents=True, exist_ok=True)
    for name, image, mask in zip(names, images, masks, strict=True):
        write_image(folder / "frames" / f"{name}.png", image)
        write_mask(folder / "masks" / f"{name}.png", mask)
    for file, document in documents.items():
        write_atomic(folder / file, json.dumps(document, indent=1).encode() + b"\n")


def _poses(spec: SyntheticSpec, camera: Camera, radius: float) -> NDArray[np.float64]:
    """``(N, 4, 4)``: a steady turn about a fixed axis, along a slightly curved path centred on the image."""
    start = Rotation.from_euler("yxz", [-30, -25, 10], degrees=True)  # shows three faces
    axis = np.asarray(spec.axis, dtype=np.float64) / np.linalg.norm(spec.axis)
    n = np.arange(spec.frames)
    turn = Rotation.from_rotvec(np.radians(spec.degrees_per_frame) * n[:, None] * axis)
    progress = n / max(spec.frames - 1, 1)
    path = progress[:, None] * np.asarray(spec.drift)
    path[:, :2] -= 0.5 * np.asarray(spec.drift[:2])
    path[:, 1] += 0.15 * abs(spec.drift[0]) * np.sin(2 * np.pi * progress)
    poses = np.tile(np.eye(4), (spec.frames, 1, 1))
    poses[:, :3, :3] = (turn * start).as_matrix()
    poses[:, :3, 3] = radius * path
    poses[:, 2, 3] += 2 * radius * camera.fy / (spec.fill * camera.height)
    return poses


LIGHT = np.array([-0.45, -0.7, -0.55]) / np.linalg.norm([-0.45, -0.7, -0.55])
"""Unit direction towards the light in camera axes: from the upper left, behind the camera."""

AMBIENT, DIFFUSE = 0.6, 0.5
"""Share of a colour that is seen in the shade, and what facing the light adds."""


def draw_convex(
    pose: NDArray[np.float64],
    camera: Camera,
    surface: ConvexSurface,
    panels: FloatImage,
    background: FloatImage,
    supersample: int,
) -> tuple[FloatImage, NDArray[np.bool_]]:
    """One noiseless image and its mask.

    Args:
        pose: ``(4, 4)`` object to camera.
        camera: Camera of the full frame.
        surface: The object.
        panels: ``(P, S, S, 3)`` texture of its panels.
        background: ``(H, W, 3)``.
        supersample: Rays per pixel and axis; odd, so that the middle one goes through the pixel's centre.

    Returns:
        Image ``(H, W, 3)`` float32 in [0, 255], and mask ``(H, W)``: whether a pixel's middle ray
        meets the object.
    """
    R, t = pose[:3, :3], pose[:3, 3]
    image, mask = background.copy(), np.zeros(background.shape[:2], bool)
    left, top, right, bottom = _bounds(t, surface.radius, camera)
    rows, columns = bottom - top, right - left
    if rows <= 0 or columns <= 0:
        return image, mask
    offset = (np.arange(supersample) - supersample // 2) / supersample
    y = (np.arange(top, bottom)[:, None] + offset).reshape(-1)
    x = (np.arange(left, right)[:, None] + offset).reshape(-1)
    u, v = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    hits = surface.cast(-R.T @ t, rays @ R)
    hit = hits.hit
    colours = np.repeat(np.repeat(image[top:bottom, left:right], supersample, 0), supersample, 1).reshape(
        -1, 3
    )
    light = np.maximum(hits.normals[hit] @ (R.T @ LIGHT), 0)
    shade = (AMBIENT + DIFFUSE * light).astype(np.float32)[:, None]
    colours[hit] = np.minimum(shade * sample_panels(panels, hits.panel[hit], hits.uv[hit]), 255)
    blocks = (rows, supersample, columns, supersample)
    image[top:bottom, left:right] = colours.reshape(*blocks, 3).mean(axis=(1, 3))
    mask[top:bottom, left:right] = hit.reshape(blocks)[:, supersample // 2, :, supersample // 2]
    return image, mask


def _bounds(centre: NDArray[np.float64], radius: float, camera: Camera) -> tuple[int, int, int, int]:
    """Left, top, right and bottom (exclusive) of the image region which a sphere may cover."""
    if centre[2] <= radius:
        return 0, 0, camera.width, camera.height
    nearest = centre[2] - radius
    corners = np.array([centre[:2] - radius, centre[:2] + radius])
    # Which depth bounds the projection depends on the sign of the coordinate: take both.
    scaled = np.concatenate([corners / nearest, corners / (centre[2] + radius)])
    x = camera.fx * scaled[:, 0] + camera.cx
    y = camera.fy * scaled[:, 1] + camera.cy
    left, right = np.clip([np.floor(x.min()) - 1, np.ceil(x.max()) + 2], 0, camera.width)
    top, bottom = np.clip([np.floor(y.min()) - 1, np.ceil(y.max()) + 2], 0, camera.height)
    return int(left), int(top), int(right), int(bottom)
