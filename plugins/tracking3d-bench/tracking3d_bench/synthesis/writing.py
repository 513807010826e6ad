"""A synthetic sequence on disk, in the layout of `tracking3d_bench.datasets.clip`."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from PIL import Image as PillowImage
from trimesh.exchange.obj import export_obj

from tracking3d.errors import OutputError
from tracking3d.geometry.camera import Camera
from tracking3d.results.files import write_atomic, write_image, write_mask, write_together, writing
from tracking3d.results.layout import partial_path
from tracking3d.runtime.interruption import interrupts_deferred
from tracking3d.testing.synthesis.convex_clips import POSE_CONVENTION
from tracking3d_bench.synthesis.camera_effects import compress
from tracking3d_bench.synthesis.frame_rendering import RenderedFrame, render_frame
from tracking3d_bench.synthesis.point_tracks import GroundTruthTracks, sample_point_tracks
from tracking3d_bench.synthesis.scene import Scene, make_scene
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec

SUITE_VERSION = 1
"""Increases with every change to the generator or the suites that changes an image or ground truth."""

_INFO = "info.json"
_SOURCE = "tracking3d synth"
_PARTS = ("frames", "masks", "visible_masks", "depth")
_COUNTS = 65_000  # of depth, at the farthest


def is_complete(folder: Path, spec: SequenceSpec) -> bool:
    """Whether ``folder`` holds exactly this sequence, made by this version."""
    try:
        info = json.loads((folder / _INFO).read_text(encoding="utf-8"))
        # Checked, not compared as text: a sequence made before a setting existed has its default.
        made = SequenceSpec.model_validate(info["spec"])
        return bool(made == spec and info["suite_version"] == SUITE_VERSION)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def write_sequence(
    folder: Path, spec: SequenceSpec, listener: Callable[[int], None] = lambda frame: None
) -> Path:
    """Render a sequence and write it, one frame in memory at a time.

    It is made in ``.NAME.part`` next to ``folder`` and takes its place when it is complete.

    Args:
        folder: Made if absent; an earlier synthetic sequence in it is replaced.
        spec: The sequence.
        listener: Called for every written frame.

    Returns:
        The folder.

    Raises:
        InputError: If the object or background cannot be used, or Embree is not installed.
        OutputError: If it cannot be written, or ``folder`` holds something else.
    """
    folder = folder.absolute()
    _check_replaceable(folder)
    scene = make_scene(spec)
    scale = _depth_scale(scene)
    partial = partial_path(folder)
    with writing(folder):
        if partial.exists():
            shutil.rmtree(partial)
        for part in _PARTS if scene.hand else set(_PARTS) - {"visible_masks"}:
            (partial / part).mkdir(parents=True)
    box: list[int] = []
    for n in range(spec.frames):
        frame = render_frame(scene, n)
        box = box or list(cv2.boundingRect(frame.visible_mask.astype(np.uint8)))
        _write_frame(partial, f"{n:06d}", frame, spec, scale)
        listener(n)
    _write_points(partial, sample_point_tracks(scene))
    _write_mesh(partial, scene.solid)
    for name, document in _documents(scene, box, scale).items():
        write_atomic(partial / name, json.dumps(document, indent=1).encode() + b"\n")
    with writing(folder):
        if folder.exists():
            shutil.rmtree(folder)
        partial.rename(folder)
    return folder


def _check_replaceable(folder: Path) -> None:
    """Refuse to replace what is no synthetic sequence."""
    with writing(folder):
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
    try:
        ours = json.loads((folder / _INFO).read_text(encoding="utf-8"))["source"] == _SOURCE
    except (OSError, ValueError, KeyError, TypeError):
        ours = False
    if not ours:
        raise OutputError(f"{folder} holds files that are not a synthetic sequence; choose another folder.")


def _write_frame(folder: Path, name: str, frame: RenderedFrame, spec: SequenceSpec, scale: float) -> None:
    if spec.disturbances.jpeg > 0:
        write_atomic(folder / "frames" / f"{name}.jpg", compress(frame.image, spec.disturbances.jpeg))
    else:
        write_image(folder / "frames" / f"{name}.png", frame.image)
    write_mask(folder / "masks" / f"{name}.png", frame.mask)
    if spec.disturbances.occluder > 0:
        write_mask(folder / "visible_masks" / f"{name}.png", frame.visible_mask)
    counts = (frame.depth / scale).round().astype(np.uint16)
    write_atomic(folder / "depth" / f"{name}.png", cv2.imencode(".png", counts)[1].tobytes())


def _write_points(folder: Path, tracks: GroundTruthTracks) -> None:
    arrays = io.BytesIO()
    np.savez_compressed(
        arrays,
        positions=tracks.positions.astype(np.float32),
        visible=tracks.visible,
        object_points=tracks.object_points,
    )
    write_atomic(folder / "points.npz", arrays.getvalue())


def _depth_scale(scene: Scene) -> float:
    """Length of a count of depth, such that the farthest depth of the sequence fits."""
    return float((scene.T_cam_obj[:, 2, 3].max() + scene.solid.radius) / _COUNTS)


def _documents(scene: Scene, box: list[int], scale: float) -> dict[str, dict[str, Any]]:
    spec, solid = scene.spec, scene.solid
    poses = {
        f"{n:06d}": {"R": T[:3, :3].tolist(), "t": T[:3, 3].tolist(), "trusted": True}
        for n, T in enumerate(scene.T_cam_obj)
    }
    units = "metres" if solid.millimetres == 1000 else "object radii, about"
    documents: dict[str, dict[str, Any]] = {
        "poses.json": {"convention": POSE_CONVENTION, "units": units, "frames": poses},
        "camera.json": {**_intrinsics(scene.given_camera), "depth_scale": scale},
        "init.json": {"frame": 0, "bbox_xywh": box, "mask": "masks/000000.png"},
    }
    if not spec.camera_told:
        documents["camera.json"] |= {"given": False, "note": "true, but not given to a tracker"}
    if scene.given_camera != scene.camera:
        documents["camera.json"]["note"] = "wrong on purpose; the true camera is in truth_camera.json"
        documents["truth_camera.json"] = {**_intrinsics(scene.camera), "depth_scale": scale}
    info: dict[str, Any] = {
        "source": _SOURCE,
        "frames": spec.frames,
        "note": _note(spec),
        "millimetres": solid.millimetres,
        "object_frame": solid.frame,
        "symmetries": solid.symmetries.tolist(),
    }
    if solid.axis is not None:
        info["symmetry"] = "continuous axis"
        info["symmetry_axis"] = {"direction": solid.axis.tolist(), "point": [0.0, 0.0, 0.0]}
    documents[_INFO] = {**info, "spec": spec.model_dump(mode="json"), "suite_version": SUITE_VERSION}
    return documents


def _intrinsics(camera: Camera) -> dict[str, Any]:
    return {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}


def _note(spec: SequenceSpec) -> str:
    look = "" if spec.textured else "textureless "
    on = [f"{name} {value:g}" for name, value in spec.disturbances if value > 0]
    return f"{look}{spec.object}, {spec.motion}; {', '.join(on) or 'undisturbed'}; the truth is exact"


def _write_mesh(folder: Path, solid: Solid) -> None:
    mesh = solid.mesh()
    if solid.texture is not None and solid.uvs is not None:
        material = trimesh.visual.material.SimpleMaterial(
            PillowImage.fromarray(solid.texture), diffuse=(255, 255, 255), name="texture"
        )
        mesh.visual = trimesh.visual.TextureVisuals(solid.uvs, material=material)
    else:
        mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=solid.colours)
    with interrupts_deferred():  # trimesh would catch them, and leave out the texture instead
        text, files = export_obj(mesh, return_texture=True, digits=9, mtl_name="mesh.mtl", header=solid.frame)
    write_together({folder / name: data for name, data in {"mesh.obj": text.encode(), **files}.items()})
