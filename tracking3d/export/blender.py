"""A folder for Blender: ``scene.py`` builds the scene from the numbers in ``scene.json`` and from ``texture.png``.

Blender's world: z up. The camera is at the origin and looks along y; the object moves before it, with its mesh in
object coordinates. Frame numbers are frame indices. In frames without a pose the object is hidden. The lens follows
the one that each pose is of.
"""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from tracking3d.export.exported_run import ExportedRun
from tracking3d.geometry.camera import Camera
from tracking3d.video.image_sequence import frames_among

WORLD_FROM_CAMERA = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])
"""``(4, 4)``: camera axes x right, y down, z forward to Blender's world x right, y forward, z up."""
SENSOR = 36.0
"""Millimetres of the sensor's width; only its ratio to the focal length means anything."""
SCRIPT, NUMBERS, TEXTURE = "scene.py", "scene.json", "texture.png"


def write_blender(run: ExportedRun, folder: Path) -> None:
    """Write script, numbers and texture."""
    folder.mkdir()
    model = run.model
    poses = [
        {
            "frame": one.index,
            "matrix_world": (WORLD_FROM_CAMERA @ one.T_cam_obj).tolist(),
            **_lens(one.camera),
        }
        for one in run.poses
    ]
    numbers = {
        "width": run.camera.width,
        "height": run.camera.height,
        "pixel_aspect": run.camera.fx / run.camera.fy,
        "fps": run.fps,
        "first": run.span[0],
        "last": run.span[-1],
        "sensor_width": SENSOR,
        "poses": poses,
        "hidden": run.without_pose,
        "vertices": model.vertices.tolist(),
        "faces": model.faces.tolist(),
        # Blender's texture coordinates have their origin in the lower left.
        "face_uvs": (model.face_uvs * (1, -1) + (0, 1)).tolist(),
        "texture": TEXTURE,
        "video": _background(run),
    }
    (folder / NUMBERS).write_text(json.dumps(numbers) + "\n", encoding="ascii")
    script = files("tracking3d.export").joinpath("blender_scene.py").read_text(encoding="utf-8")
    (folder / SCRIPT).write_text(script, encoding="utf-8")
    Pillow.fromarray(model.texture).save(folder / TEXTURE)


def _lens(camera: Camera) -> dict[str, float]:
    """Focal length in millimetres, and the shift of the lens in widths of the picture."""
    return {
        "lens": camera.fx / camera.width * SENSOR,
        "shift_x": ((camera.width - 1) / 2 - camera.cx) / camera.width,
        "shift_y": (camera.cy - (camera.height - 1) / 2) / camera.width * camera.fx / camera.fy,
    }


def _background(run: ExportedRun) -> str | None:
    """The video, or the first image of its folder, if it is still at its path and fits the camera."""
    if run.camera.lens is not None:  # the scene's camera has none of its distortion
        return None
    source = Path(run.options.source or str(run.reader.description.get("source", "")))
    if source.is_dir():
        return next((str(path.resolve()) for path in frames_among(source.iterdir())[0]), None)
    return str(source.resolve()) if source.is_file() else None
