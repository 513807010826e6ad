"""A printed thing with its true mesh as a file, and short videos of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from tracking3d.config.loading import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d_bench.synthesis.sequences import RenderedSequence, render_sequence
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec


def filmed(**more: Any) -> RenderedSequence:
    """A printed box that tumbles; the seed says how it looks."""
    settings: dict[str, Any] = {"frames": 3, "size": (200, 150), "seed": 1, "supersample": 1} | more
    return render_sequence(SequenceSpec(**settings))


def mesh_of(solid: Solid, textured: bool = True) -> trimesh.Trimesh:
    """The solid with its print, or without."""
    mesh = trimesh.Trimesh(solid.vertices, solid.faces, process=False)
    if textured:
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(solid.texture))
        mesh.visual = trimesh.visual.TextureVisuals(solid.uvs, material=material)
    return mesh


def written(solid: Solid, folder: Path, textured: bool = True) -> Path:
    """The solid as a mesh file."""
    path = folder / f"thing_{textured}.glb"
    mesh_of(solid, textured).export(path)
    return path


def config(**more: Any) -> PipelineConfig:
    """With the true lens."""
    return load_config(camera={"fov": 45}, **more)


def box_of(mask: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    """Around a mask."""
    y, x = np.nonzero(mask)
    return float(x.min()), float(y.min()), float(np.ptp(x) + 1), float(np.ptp(y) + 1)


def degrees_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Of the rotations of two poses."""
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
