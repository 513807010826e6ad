"""Rigid points on a solid that turns in front of a camera, and their exact or disturbed tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.points.bundle_adjustment.adjustment import Structure, Tracks
from tracking3d.points.bundle_adjustment.reprojection import project_camera_points, transform_to_camera

SIZE = (640, 480)
RADIUS = 0.9


@dataclass(frozen=True, eq=False)
class Scene:
    K: NDArray[np.float64]
    truth: Structure
    tracks: Tracks
    outliers: NDArray[np.bool_]


def intrinsics(fov: float) -> NDArray[np.float64]:
    focal = SIZE[1] / 2 / np.tan(np.radians(fov) / 2)
    return np.array([[focal, 0, SIZE[0] / 2 - 0.5], [0, focal, SIZE[1] / 2 - 0.5], [0, 0, 1.0]])


def solid(
    shape: str, count: int, random: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points ``(N, 3)`` on a surface and its normals there."""
    if shape == "ellipsoid":
        axes = np.array([0.9, 0.7, 0.6])
        ball = random.normal(size=(count, 3))
        ball /= np.linalg.norm(ball, axis=1, keepdims=True)
        return ball * axes, ball / axes
    if shape == "box":
        points = random.uniform(-1, 1, size=(count, 3))
        normals = np.zeros((count, 3))
        rows, side = np.arange(count), random.integers(0, 3, count)
        points[rows, side] = normals[rows, side] = random.choice([-1, 1], count)
        turned = Rotation.from_euler("xyz", [25, 35, 10], degrees=True).as_matrix()
        return (points * [0.6, 0.5, 0.45]) @ turned.T, normals @ turned.T
    tilted = Rotation.from_euler("xyz", [20, -25, 0], degrees=True).as_matrix()
    points = np.column_stack([random.uniform(-0.7, 0.7, (count, 2)), np.zeros(count)])
    return points @ tilted.T, np.tile([0.0, 0.0, -1.0], (count, 1)) @ tilted.T


def scene(
    frames: int = 6,
    count: int = 80,
    *,
    shape: str = "ellipsoid",
    fov: float = 45.0,
    turn: float = 30.0,
    axis: tuple[float, float, float] = (0.3, 1.0, 0.1),
    noise: float = 0.0,
    outliers: float = 0.0,
    seed: int = 0,
) -> Scene:
    """A solid of radius 0.9, a third as high as the image, that turns and wanders a little.

    A point is visible where its side of the surface faces the camera. Outliers slide by two pixels a frame.
    """
    random = np.random.default_rng(seed)
    K = intrinsics(fov)
    z0 = RADIUS * K[1, 1] / (0.35 * SIZE[1] / 2)
    points, normals = solid(shape, 4 * count, random)
    direction = np.array(axis) / np.linalg.norm(axis)
    R = Rotation.from_rotvec(np.radians(np.linspace(0, turn, frames))[:, None] * direction).as_matrix()
    t = np.array([0.05 * z0, 0.03 * z0, z0]) + np.linspace(0, 1, frames)[:, None] * [0.1, -0.05, 0.2]
    x_cam = transform_to_camera(R, t, points)
    facing = np.sum((normals @ R.transpose(0, 2, 1)) * x_cam, -1) < -0.1 * np.linalg.norm(x_cam, axis=-1)
    kept = np.flatnonzero(facing.sum(0) >= min(3, frames))[:count]
    pixels, visible = project_camera_points(x_cam[:, kept], K), facing[:, kept]
    pixels = pixels + noise * random.normal(size=pixels.shape)
    wrong = random.random(len(kept)) < outliers
    slide = 2 * random.normal(size=(len(kept), 2)) * np.arange(frames)[:, None, None]
    pixels = np.where(wrong[:, None], pixels + slide, pixels)
    pixels = np.where(visible[..., None], pixels, np.nan)
    return Scene(K, Structure(R, t, points[kept]), Tracks(pixels, visible), wrong)


def disturbed(truth: Structure, degrees: float = 6.0, shift: float = 0.1, seed: int = 1) -> Structure:
    """Other poses and points than the true ones; frame 0 is kept."""
    random = np.random.default_rng(seed)
    frames = len(truth.R)
    R = Rotation.from_rotvec(np.radians(degrees) * random.normal(size=(frames, 3))).as_matrix() @ truth.R
    t = truth.t + shift * random.normal(size=(frames, 3))
    R[0], t[0] = truth.R[0], truth.t[0]
    return Structure(R, t, truth.points + shift * random.normal(size=truth.points.shape))


def degrees_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles between rotations ``(..., 3, 3)``."""
    return np.degrees(np.atleast_1d(Rotation.from_matrix(a @ np.swapaxes(b, -1, -2)).magnitude()))
