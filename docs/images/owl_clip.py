"""Films the owl of `owl.py` on a turntable in front of a still camera: the clip of the README's picture.

The ray caster, lamp, noise and compression are those of `tracking3d synth`. The room and the shadow are rendered once,
the owl in every frame. Poses and masks are exact.

$ python docs/images/owl_clip.py clips/owl
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from owl import build_owl
from PIL import Image, ImageDraw
from scipy.spatial.transform import Rotation

from tracking3d.testing.synthesis.convex_clips import write_clip
from tracking3d_bench.synthesis.camera_effects import compress as encode_jpeg
from tracking3d_bench.synthesis.camera_effects import linear
from tracking3d_bench.synthesis.frame_rendering import render_frame
from tracking3d_bench.synthesis.lighting import lamp_at
from tracking3d_bench.synthesis.motions import Path as Motion
from tracking3d_bench.synthesis.ray_casting import RayMesh
from tracking3d_bench.synthesis.room import Room
from tracking3d_bench.synthesis.room_rendering import room_light
from tracking3d_bench.synthesis.scene import Scene, make_scene
from tracking3d_bench.synthesis.spec import Disturbances, SequenceSpec
from tracking3d_bench.synthesis.texture_lookup import pyramid

Array = NDArray[np.float64]

TILT = 18.0
"""Degrees that the camera looks down."""
LIGHTS = 32
"""Rays per pixel of the room; each sees the shadow at another moment of the turn."""


# Lengths in the room are in radii of the owl.


def paint_planks(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Paint the square texture of the table top."""
    picture = Image.new("RGB", (1024, 1024))
    pen = ImageDraw.Draw(picture)
    for y in range(0, 1024, 146):
        base = np.array([126, 110, 98]) + rng.integers(-14, 14)
        pen.rectangle([0, y, 1024, y + 146], fill=tuple(base.tolist()))
        for _ in range(90):
            x, at = rng.uniform(-200, 1024), y + rng.uniform(2, 144)
            ink = tuple((base - rng.integers(4, 34)).tolist())
            pen.line(
                [(x, at), (x + rng.uniform(80, 500), at + rng.uniform(-5, 5))],
                fill=ink,
                width=int(rng.integers(1, 4)),
            )
        pen.line([(0, y), (1024, y)], fill="#3a322c", width=4)
    return cv2.GaussianBlur(np.asarray(picture), (0, 0), 1.2)


def paint_wall(rng: np.random.Generator) -> NDArray[np.uint8]:
    """Paint a wall with a picture and a shelf of books, out of focus: 16 x 8 radii, 100 pixels each."""
    picture = Image.new("RGB", (1600, 800), "#8b9bab")
    pen = ImageDraw.Draw(picture)
    pen.rectangle([560, 130, 760, 330], fill="#39434d")
    pen.rectangle([576, 146, 744, 314], fill="#b9c6d2")
    pen.ellipse([610, 180, 710, 280], fill="#5d6f86")
    pen.rectangle([0, 610, 1600, 634], fill="#4c5560")
    x = 120.0
    while x < 1500:
        if 940 < x < 960:
            x = 1010.0
        wide, tall = rng.uniform(22, 58), rng.uniform(130, 210)
        ink = np.array([[92, 86, 112], [58, 70, 92], [112, 122, 128], [84, 104, 92], [128, 112, 124]])[
            rng.integers(5)
        ]
        pen.rectangle([x, 610 - tall, x + wide, 609], fill=tuple((ink + rng.integers(-18, 18, 3)).tolist()))
        pen.rectangle([x + 5, 610 - 0.85 * tall, x + wide - 5, 610 - 0.75 * tall], fill="#aab4be")
        x += wide + float(rng.choice([1.0, 2.0, 30.0]))
    blurred = cv2.GaussianBlur(np.asarray(picture).astype(np.float32), (0, 0), 9)
    shade = np.linspace(1.08, 0.8, 1600)[None, :, None] * np.linspace(1.0, 0.86, 800)[:, None, None]
    return (blurred * shade).clip(0, 255).astype(np.uint8)


def build_room(scene: Scene, T_cam_room: Array) -> Room:
    """Build the table, the turntable on it, and the wall behind."""
    r = scene.solid.radius
    top = scene.solid.vertices[:, 1].min() / r
    disc = trimesh.creation.cylinder(0.80, 0.06, sections=128)
    disc.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    disc.apply_translation((0, top - 0.032, 0))
    table = trimesh.creation.box((7, 0.1, 4.0))
    table.apply_translation((0, top - 0.112, 0.2))
    both = [table, disc]
    furniture = trimesh.Trimesh(
        np.concatenate([r * one.vertices for one in both]),
        np.concatenate([table.faces, disc.faces + len(table.vertices)]),
        process=False,
    )
    uvs = furniture.vertices[:, [0, 2]] / (7 * r) + 0.5
    looks = np.repeat([6, 7], [len(one.faces) for one in both])
    rng = np.random.default_rng(12)
    pale = np.full((64, 64, 3), (198, 205, 212), np.uint8)
    plain = np.full((64, 64, 3), (150, 158, 166), np.uint8)
    pictures = [plain, plain, plain, plain, paint_wall(rng), plain, paint_planks(rng), pale]
    T_obj_room = np.linalg.inv(scene.T_cam_obj[0]) @ T_cam_room
    textures = [pyramid(linear(one)) for one in pictures]
    density = np.where(looks == 6, 1024, 64) / (7 * r)
    low, high = r * np.array([-8, -4.2, -5.5]), r * np.array([8, 3.8, 8])
    return Room(T_obj_room, low, high, RayMesh.of(furniture), uvs, looks, density, textures)


def render_surroundings(scene: Scene, T_cam_room: Array) -> NDArray[np.float32]:
    """Linear light of the room without the owl, ``(H, W, 3)``; its soft shadow is the mean over the whole turn."""
    spec, poses = scene.spec, scene.T_cam_obj
    room = build_room(scene, T_cam_room)
    lamp = lamp_at(spec, 0, poses[0, :3, 3], scene.solid.radius)
    width, height = spec.size
    rows, columns = (one.ravel() for one in np.mgrid[:height, :width])
    light, rng = np.zeros((height * width, 3)), np.random.default_rng(5)
    for n, source in enumerate(lamp.points(LIGHTS)):
        T = poses[n * 37 % len(poses)]
        now = replace(room, T_obj_room=np.linalg.inv(T) @ T_cam_room)
        dx, dy = rng.uniform(-0.5, 0.5, 2)
        light += room_light(scene, now, T, columns + dx, rows + dy, lamp, source)[0]
    return (light / LIGHTS).reshape(height, width, 3).astype(np.float32)


def build_scene(mesh: Path, frames: int, size: tuple[int, int]) -> Scene:
    """The owl, once around, in front of the rendered room."""
    effects = Disturbances(noise=0.12, jpeg=0.25, highlights=0.12)
    scene = make_scene(
        SequenceSpec(
            object=str(mesh),
            motion="turntable",
            frames=frames,
            size=size,
            fill=0.8,
            lamp=(-0.75, -0.75, -0.5),
            disturbances=effects,
        )
    )
    times = np.arange(frames + 1.0)
    turn = 2 * np.pi * times / frames
    turn += 0.05 * np.sin(2 * turn) - 0.5  # as a hand turns it; it begins a little aside
    upright = Rotation.from_euler("x", TILT, degrees=True) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    stays = np.tile(scene.path.positions.mean(0) * (0, 0, 1), (frames + 1, 1))
    scene = replace(
        scene, path=Motion(times, upright * Rotation.from_rotvec(turn[:, None] * (0, 1, 0)), stays)
    )
    T_cam_room = np.eye(4)
    T_cam_room[:3, :3], T_cam_room[:3, 3] = upright.as_matrix(), stays[0]
    return replace(scene, background=render_surroundings(scene, T_cam_room))


def compress(image: NDArray[np.uint8], strength: float) -> NDArray[np.uint8]:
    """The image after JPEG compression."""
    return np.asarray(
        cv2.imdecode(np.frombuffer(encode_jpeg(image, strength), np.uint8), cv2.IMREAD_COLOR_RGB)
    )


def main() -> None:
    """Write the clip and print the box of its first frame."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    build_owl().export(given.folder / "mesh.obj")
    scene = build_scene(given.folder / "mesh.obj", given.frames, tuple(given.size))
    frames = [render_frame(scene, n) for n in range(given.frames)]
    write_clip(
        given.folder,
        np.stack([compress(one.image, scene.spec.disturbances.jpeg) for one in frames]),
        np.stack([one.mask for one in frames]),
        scene.T_cam_obj,
        scene.camera,
        source="docs/images/owl_clip.py",
        note="synthetic: a painted owl on a turntable before a still camera",
    )
    print("--box", ",".join(map(str, cv2.boundingRect(frames[0].mask.astype(np.uint8)))))


if __name__ == "__main__":
    main()
