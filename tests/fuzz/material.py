"""What cases are made from: a tiny clip as images, video and arrays, its masks, a mesh, a finished run."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
import yaml
from PIL import Image

from tracking3d.config.loading import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d.pipeline.record import record
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize, write_clip
from tracking3d.video import VideoWriter, open_source

FRAMES, WIDTH, HEIGHT = 3, 64, 48

TINY = {
    "crop": {"size": 32},
    "object": {"frequency": 2, "texture_size": 16},
    "solver": {"final_refine": False},
    "features": "rgb",
}
"""Settings with which a run takes no longer than reading its input."""


@dataclass(frozen=True)
class Material:
    """Where things are; nobody changes them in place."""

    folder: Path
    clip: SyntheticClip
    config: PipelineConfig

    @property
    def box(self) -> str:
        """The object's box as the command line takes it."""
        return ",".join(f"{value:g}" for value in self.clip.box)

    def copy(self, name: str, into: Path) -> Path:
        """A copy of a file or folder to spoil."""
        source, target = self.folder / name, into / name
        if source.is_dir():
            shutil.copytree(source, target)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, target)
        return target


def make_material(folder: Path) -> Material:
    """Make everything once."""
    clip = synthesize(SyntheticSpec(frames=FRAMES, size=(WIDTH, HEIGHT), supersample=1))
    (folder / "images").mkdir()
    (folder / "masks").mkdir()
    for number, (image, mask) in enumerate(zip(clip.images, clip.masks, strict=True)):
        Image.fromarray(image).save(folder / "images" / f"{number:06d}.png")
        Image.fromarray(mask).save(folder / "masks" / f"{number:06d}.png")
    Image.fromarray(clip.images[0]).save(folder / "first.jpg")
    Image.fromarray(clip.masks[0]).save(folder / "mask.png")
    np.savez_compressed(folder / "masks.npz", masks=clip.masks)
    np.save(folder / "masks.npy", clip.masks)
    with VideoWriter(folder / "clip.mp4", 25, (HEIGHT, WIDTH)) as writer:
        for image in clip.images:
            writer.write(image)
    motion_jpeg = cv2.VideoWriter(
        str(folder / "clip.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25, (WIDTH, HEIGHT)
    )
    for image in clip.images:
        motion_jpeg.write(np.ascontiguousarray(image[..., ::-1]))
    motion_jpeg.release()
    frames = [Image.fromarray(image) for image in clip.images]
    frames[0].save(folder / "clip.gif", save_all=True, append_images=frames[1:])
    solid = trimesh.creation.icosphere(1)
    for suffix in ("obj", "ply", "stl", "glb", "off"):
        solid.export(folder / f"mesh.{suffix}")
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY), encoding="utf-8")
    write_clip(
        folder / "truth", clip.images, clip.masks, clip.T_cam_obj, clip.camera, source="synthetic", note=""
    )
    config = load_config(folder / "tiny.yaml")
    record(open_source(folder / "images"), config, folder / "run", mask=clip.masks[0])
    return Material(folder, clip, config)
