"""One GLB with the object moving in front of the camera, as a glTF animation.

glTF's axes: y up, the camera at the origin looks along -z. Nodes: ``tracking3d_object``, whose translation and
rotation are animated, with the mesh in object coordinates; ``tracking3d_camera``, still. Between frames, and over
those without a pose, viewers interpolate. glTF knows no shifted principal point, so the camera's is in the middle.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.export.axes import HALF_TURN, continuous, quaternion
from tracking3d.export.exported_run import ExportedRun
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.gltf_axes import OBJECT_NODE
from tracking3d.results.mesh_export import glb_file

CAMERA_NODE = "tracking3d_camera"
_FLOAT = 5126  # glTF's constant
_NEAREST = 0.01
"""Depth of the near plane, in depths of the object's origin in its nearest frame."""
_LEAST_NEAR = 1e-6
"""glTF wants it above 0, wherever a damaged run has the object."""


def write_animated_glb(run: ExportedRun, path: Path) -> None:
    """Write the animation at the source's frame rate, time 0 being frame 0."""
    T_view_obj = [HALF_TURN @ one.T_through(run.camera) for one in run.poses]
    seconds = [one.index / run.fps if (time := run.seconds(one.index)) is None else time for one in run.poses]
    tracks = {
        "time": np.array(seconds, "<f4"),
        "translation": np.array([T[:3, 3] for T in T_view_obj], "<f4"),
        # glTF's quaternions are x, y, z, w.
        "rotation": np.roll(continuous(np.array([quaternion(T) for T in T_view_obj])), -1, axis=1).astype(
            "<f4"
        ),
    }

    def append(buffers: MutableMapping[str, bytes], tree: dict[str, Any]) -> None:
        for name, values in tracks.items():
            buffers[f"animated {name}"] = values.tobytes()

    def animate(tree: dict[str, Any]) -> None:
        accessors = _add_accessors(tree, tracks)
        depth = float(-tracks["translation"][:, 2].max())
        _add_scene(tree, run.camera, max(_NEAREST * depth, _LEAST_NEAR), tracks)
        paths = ("translation", "rotation")
        tree["animations"] = [
            {
                "name": "tracking3d",
                "samplers": [{"input": accessors["time"], "output": accessors[path]} for path in paths],
                "channels": [
                    {"sampler": n, "target": {"node": 0, "path": path}} for n, path in enumerate(paths)
                ],
            }
        ]

    path.write_bytes(glb_file(run.model, finish=animate, unit=run.unit, buffer_postprocessor=append))


def _add_accessors(tree: dict[str, Any], tracks: dict[str, NDArray[np.float32]]) -> dict[str, int]:
    """Describe the tracks, which are the last of the buffer's views; where each description is."""
    places = {}
    first = len(tree["bufferViews"]) - len(tracks)
    for view, (name, values) in enumerate(tracks.items(), first):
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values[0].size]
        accessor = {"bufferView": view, "componentType": _FLOAT, "count": len(values), "type": kind}
        if name == "time":  # of the times of an animation glTF wants the range
            accessor |= {"min": [float(values.min())], "max": [float(values.max())]}
        places[name] = len(tree["accessors"])
        tree["accessors"].append(accessor)
    return places


def _add_scene(
    tree: dict[str, Any], camera: Camera, near: float, tracks: dict[str, NDArray[np.float32]]
) -> None:
    """The object, with the pose of the first frame as rest pose, and the camera."""
    place = {name: tracks[name][0].tolist() for name in ("translation", "rotation")}
    perspective = {
        "yfov": 2 * math.atan2(camera.height / 2, camera.fy),
        "aspectRatio": camera.width / camera.fx * camera.fy / camera.height,
        "znear": near,
    }
    tree["cameras"] = [{"name": CAMERA_NODE, "type": "perspective", "perspective": perspective}]
    tree["nodes"] = [{"name": OBJECT_NODE, "mesh": 0, **place}, {"name": CAMERA_NODE, "camera": 0}]
    tree["scenes"] = [{"nodes": [0, 1]}]
