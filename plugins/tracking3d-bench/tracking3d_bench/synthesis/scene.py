"""The parts of a sequence that are made once: the object, its path, camera, background or room, and occluder."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path as FilePath

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import hint
from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.backgrounds import make_background
from tracking3d_bench.synthesis.camera_effects import linear
from tracking3d_bench.synthesis.grip import make_grip
from tracking3d_bench.synthesis.mesh_files import load_solid
from tracking3d_bench.synthesis.motions import Path, make_path
from tracking3d_bench.synthesis.occluder import Occluder, make_hand
from tracking3d_bench.synthesis.pick_up import PICK_UP, plan_pick_up
from tracking3d_bench.synthesis.procedural_solids import PROCEDURAL, make_procedural_solid
from tracking3d_bench.synthesis.ray_casting import RayMesh
from tracking3d_bench.synthesis.room import Room, build_room
from tracking3d_bench.synthesis.solid import Solid, fade_texture
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.tabletop import Tabletop, build_tabletop

Array = NDArray[np.float64]

_WIDEST = 120.0  # degrees; no tracker is given a wider field of view


@dataclass(frozen=True, eq=False)
class Scene:
    """What frames are rendered from."""

    spec: SequenceSpec  # what was asked for
    camera: Camera  # the true camera of all frames
    given_camera: Camera  # the camera given to a tracker; a wrong one if `Disturbances.wrong_fov` is on
    solid: Solid  # the object
    surface: RayMesh  # the object for rays
    path: Path  # its poses over time
    background: NDArray[np.float32]  # (H, W, 3) linear light
    hand: Occluder | None  # what moves in front of it
    # (h, w, 3) linear light, no finer than the rays resolve; None if vertices have colours
    texture: NDArray[np.float32] | None
    # what is around the object instead of the background if the camera walks round it, else None
    room: Room | None
    # the table that the object is taken from instead of the background, else None
    tabletop: Tabletop | None = None

    @property
    def T_cam_obj(self) -> Array:
        """``(N, 4, 4)`` poses of all frames."""
        return self.path.T_cam_obj(np.arange(self.spec.frames, dtype=np.float64))


def make_scene(spec: SequenceSpec) -> Scene:
    """Prepare a sequence.

    Raises:
        InputError: If its object or background cannot be used, or Embree is not installed.
    """
    camera = Camera.from_fov(*spec.size, spec.fov, origin="synthetic")
    solid = make_solid(spec)
    surface = RayMesh.of(solid.mesh())
    background = linear(make_background(spec))
    told = _given_camera(spec, camera)
    if spec.motion == PICK_UP:
        path, handling = plan_pick_up(spec, solid, camera)
        grip = make_grip(spec, handling, path, surface, camera)
        tabletop = build_tabletop(spec, solid, path, camera)
        # Inside outlines there is one ray a pixel.
        texture = _resolved_texture(solid, camera, path, 1)
        return Scene(spec, camera, told, solid, surface, path, background, grip, texture, None, tabletop)
    path = make_path(spec, camera, solid.radius)
    hand = make_hand(spec, path, surface, solid.radius, camera)
    texture = _resolved_texture(solid, camera, path, spec.supersample)
    room = build_room(spec, solid, path)
    return Scene(spec, camera, told, solid, surface, path, background, hand, texture, room)


def _given_camera(spec: SequenceSpec, camera: Camera) -> Camera:
    if spec.disturbances.wrong_fov == 0:
        return camera
    told = min(spec.fov * (1 + spec.disturbances.wrong_fov), _WIDEST)
    return Camera.from_fov(*spec.size, told, origin="synthetic, wrong on purpose")


def make_solid(spec: SequenceSpec) -> Solid:
    """The object of a sequence.

    Raises:
        InputError: If it is neither a procedural object nor a mesh file with faces.
    """
    if spec.object in PROCEDURAL:
        return fade_texture(make_procedural_solid(spec), spec.print_strength)
    file = FilePath(spec.object)
    if not file.suffix and not file.exists():
        raise InputError(
            f"There is no object or mesh file '{spec.object}' (objects: {', '.join(PROCEDURAL)}); "
            f"{hint(spec.object, PROCEDURAL)}"
        )
    return fade_texture(load_solid(file, spec), spec.print_strength)


def _resolved_texture(
    solid: Solid, camera: Camera, path: Path, supersample: int
) -> NDArray[np.float32] | None:
    """The texture in linear light, halved until texels are about as far apart as rays where the object is nearest."""
    if solid.texture is None or solid.uvs is None:
        return None
    texture = linear(solid.texture)
    height, width = texture.shape[:2]
    ab, ac = _edges(solid.vertices[solid.faces])
    area = np.linalg.norm(np.cross(ab, ac), axis=1).sum()
    uv_ab, uv_ac = _edges(solid.uvs[solid.faces] * (width, height))
    texels = np.abs(uv_ab[:, 0] * uv_ac[:, 1] - uv_ab[:, 1] * uv_ac[:, 0]).sum()
    rays = supersample * camera.fy / max(path.positions[:, 2].min(), solid.radius)  # per unit of length
    finer = math.sqrt(texels / area) / rays if area > 0 else 1.0
    factor = 2 ** max(0, round(math.log2(max(finer, 1.0)) - 0.25))
    size = max(1, width // factor), max(1, height // factor)
    return texture if factor == 1 else cv2.resize(texture, size, interpolation=cv2.INTER_AREA)


def _edges(triangles: Array) -> tuple[Array, Array]:
    return triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
