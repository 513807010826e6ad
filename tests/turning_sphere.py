"""A turning sphere, painted and tracked without error, for tests of run folders and of what is made from them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.surface import sample_texture
from tracking3d.rendering.visibility import rasterize
from tracking3d.results.description import RunHeader
from tracking3d.results.run_writer import RunWriter


@dataclass(frozen=True)
class TurningSphere:
    """A clip of known truth and the perfect answers for it."""

    camera: Camera
    model: ObjectModel
    frames: list[Frame]
    estimates: list[FrameEstimate]


def painted_sphere(frequency: int = 6, texture_size: int = 64) -> ObjectModel:
    """A unit sphere whose texture has no two texels alike; its lower part was never seen."""
    mesh = sphere(frequency)
    v, u = np.mgrid[:texture_size, :texture_size] / texture_size
    tiles = (np.floor(u * 8) + np.floor(v * 8)) % 2
    texture = np.stack([255 * u, 255 * v, 200 * tiles + 20], axis=2).astype(np.uint8)
    weight = (v < 0.8).astype(np.float32)
    features = np.random.default_rng(0).random((texture_size, texture_size, 3), dtype=np.float32)
    return ObjectModel(mesh.vertices, mesh.faces, mesh.face_uvs, texture, weight, features)


def pose(turn: float, translation: tuple[float, float, float] = (0.0, 0.0, 4.0)) -> NDArray[np.float64]:
    """Object to camera, turned by ``turn`` degrees around a slanted axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(math.radians(turn) * np.array([0.0, 0.96, 0.28])).as_matrix()
    T[:3, 3] = translation
    return T


def draw(
    model: ObjectModel, T: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The picture of the model over a grey ramp, and its mask."""
    points = model.vertices @ T[:3, :3].T + T[:3, 3]
    screen = torch.tensor((points @ camera.K.T)[:, :2] / points[:, 2:])[None]
    depth, faces = torch.tensor(points[:, 2])[None], torch.tensor(model.faces)
    face_index = rasterize(screen, depth, faces, (camera.height, camera.width)).face_index
    uv = interpolate(screen, depth, faces, torch.tensor(model.face_uvs), face_index)
    image = np.repeat(np.linspace(60, 160, camera.width)[None, :, None], camera.height, 0).repeat(3, 2)
    mask = (face_index[0] >= 0).numpy()
    image[mask] = sample_texture(
        torch.tensor(model.texture, dtype=torch.float64).permute(2, 0, 1), uv
    ).numpy()
    return image.astype(np.uint8), mask


def turning_sphere_of(count: int, width: int = 160, height: int = 120, step: float = 6.0) -> TurningSphere:
    """``count`` frames of the painted sphere, which turns and drifts to the right."""
    camera, model = Camera.from_fov(width, height), painted_sphere()
    frames, estimates = [], []
    for index in range(count):
        T = pose(step * index, (-0.6 + 1.2 * index / max(count - 1, 1), 0.1, 4.0))
        image, mask = draw(model, T, camera)
        frames.append(Frame(index, image, index / 30, f"{index:06d}.jpg"))
        estimates.append(
            FrameEstimate(
                index=index,
                time=index / 30,
                T_cam_obj=T,
                mask=mask,
                initial_mask=np.roll(mask, 3, axis=1),
                status=Status.TRACKED,
                reason="appearance loss below tau",
                confidence=0.9,
                losses={"appearance": 0.01, "silhouette": 0.02},
                iterations=12,
                keyframe=index % 5 == 0,
                seconds=0.25,
            )
        )
    return TurningSphere(camera, model, frames, estimates)


def started_run(folder: Path, clip: TurningSphere, **changes: Any) -> RunWriter:
    """A writer of the clip's run, before its first frame."""
    arguments = {
        "config": {"solver": {"name": "paper", "iterations": 500}},
        "camera": clip.camera,
        "source": "clip.mp4",
        "seed": 7,
        "fps": 30.0,
        "command": "tracking3d run clip.mp4",
    }
    settings = {name: changes.pop(name) for name in ("overwrite", "resume") if name in changes}
    return RunWriter(folder, RunHeader(**(arguments | changes)), **settings)


def written_run(folder: Path, clip: TurningSphere, *, with_model: bool = True, **changes: Any) -> None:
    """Write the whole run of the clip; its model takes most of the time."""
    with started_run(folder, clip, **changes) as writer:
        for frame, estimate in zip(clip.frames, clip.estimates, strict=True):
            writer.write(estimate, frame)
        writer.finish(clip.model if with_model else None, "finished")
