"""Run folders that are written in a moment, for what looks at them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.results.description import RunHeader
from tracking3d.results.run_writer import RunWriter

WIDTH, HEIGHT = 96, 64


def frame_of(index: int) -> Frame:
    """A picture of which no two are alike."""
    image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
    image[20:44, 30:66] = (30 + 7 * index % 220, 160, 90)
    image[:8, : 2 + index % (WIDTH - 2)] = 200
    return Frame(index, image, index / 10, f"{index:06d}.png")


def estimate_of(index: int, status: Status = Status.TRACKED, reason: str = "", **more: Any) -> FrameEstimate:
    """An answer for it; the object turns by two degrees a frame."""
    angle = math.radians(2 * index)
    T = np.eye(4)
    T[:3, :3] = [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    T[2, 3] = 4
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[20:44, 30:66] = True
    return FrameEstimate(
        index,
        index / 10,
        T,
        mask,
        mask,
        status,
        reason,
        0.9 if status == Status.TRACKED else 0.3,
        {"appearance": 0.1 + 0.01 * (index % 5)},
        keyframe=index % 7 == 0,
        seconds=0.1,
        camera=Camera.from_fov(WIDTH, HEIGHT),
        **more,
    )


def model() -> ObjectModel:
    """A sphere with a texture."""
    ball = trimesh.creation.icosphere(2)
    uvs = np.random.default_rng(0).random((*ball.faces.shape, 2)) * 0.5 + 0.25
    texture = np.random.default_rng(1).integers(0, 255, (16, 16, 3), dtype=np.uint8)
    weight = np.ones((16, 16), np.float32)
    return ObjectModel(ball.vertices, ball.faces, uvs, texture, weight, np.zeros((16, 16, 3), np.float32))


def write_frames(folder: Path, count: int) -> Path:
    """The pictures as files."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        frame = frame_of(index)
        Image.fromarray(frame.image).save(folder / frame.name)
    return folder


def open_run(folder: Path, source: str = "frames") -> RunWriter:
    """A run that goes on."""
    header = RunHeader(
        config={"tracker": {"name": "csrt"}},
        camera=Camera.from_fov(WIDTH, HEIGHT),
        source=source,
        seed=0,
        fps=10,
        command="tracking3d run",
    )
    return RunWriter(folder, header)


def write_run(folder: Path, count: int = 12, doubts: dict[int, tuple[Status, str]] | None = None) -> Path:
    """A finished run, with the frames that it was made from beside it."""
    source = write_frames(folder.parent / f"{folder.name}_frames", count)
    with open_run(folder, str(source)) as writer:
        for index in range(count):
            estimate = estimate_of(index, *(doubts or {}).get(index, ()))
            writer.write(estimate, frame_of(index))
        writer.finish(model(), "finished")
    return folder


def append_lines(folder: Path, count: int) -> None:
    """Make a finished run as long as ``count`` frames, by lines alone: what a long one tells, without its pictures."""
    path = folder / "frames.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    with path.open("a") as file:
        for index in range(len(lines), count):
            line = {
                **lines[index % len(lines)],
                "index": index,
                "name": f"{index:06d}.png",
                "time": index / 10,
            }
            file.write(json.dumps(line) + "\n")
