"""What ``object.model`` names, read: the run folder of an object that was tracked before, or any mesh file."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.camera import choose_camera
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, argument
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.estimation.online.known_object import KnownObject
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.mesh_checks import sound_mesh_file, what_is_wrong
from tracking3d.rendering.backprojection import TexelMap, face_atlas, on_faces, paint_faces, shares_no_texel
from tracking3d.rendering.surface import sample_texture
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_reader import RunReader

if TYPE_CHECKING:
    import trimesh

_OBJECT = argument("object=", "--object ")
_ADVICE = "give the folder of an earlier run, or a mesh file such as GLB, OBJ, PLY or STL"
_MOST_FACES = 100_000  # each is projected for every pose that is tried
_LARGEST_TEXTURE, _SMALLEST_TEXTURE = 2048, 256
_TEXELS_OF_A_FACE = 10  # along a side of its cell, for meshes without a usable atlas
_GREY = 165

_log = logging.getLogger(__name__)


def load_known_object(config: PipelineConfig) -> KnownObject | None:
    """The object that a configuration names; None if none is known before the video.

    Raises:
        InputError: If it cannot be used, or not with this solver.
    """
    path = config.object.model
    if path is None:
        return None
    if config.solver.name != "online":
        raise InputError(
            f"{_OBJECT}{path}: the solver {config.solver.name} begins without a known object; leave it to the "
            "default one, online."
        )
    if config.object.flat:
        raise InputError(
            f"{_OBJECT}{path} has its shape, flat or not; leave out {argument('object.flat', '--flat')}."
        )
    return read_known_object(Path(path))


def read_known_object(path: Path) -> KnownObject:
    """The object of a run folder or a mesh file.

    Raises:
        InputError: If there is none, or it cannot be used.
    """
    try:
        is_folder, is_file = path.is_dir(), path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        is_folder = is_file = False
    if not (is_folder or is_file):
        raise InputError(f"{_OBJECT}{path} does not exist; {_ADVICE}.")
    return _of_run(path) if is_folder else _of_mesh(path)


def select_camera(
    config: PipelineConfig,
    width: int,
    height: int,
    intrinsics: tuple[float, float, float, float] | None,
    origin: str,
) -> Camera:
    """The camera of a video: if its lens is not given, that of the run with the object.

    This holds only if both have images of the same size, and the run's lens was given or solved, not assumed.

    Raises:
        InputError: See `tracking3d.config.camera.choose_camera`.
    """
    camera = choose_camera(config.camera, width, height, intrinsics, origin)
    path = config.object.model
    if not camera.assumed or path is None or not Path(path).is_dir():
        return camera
    earlier = RunReader(Path(path)).camera
    if not earlier.known or (earlier.width, earlier.height) != (width, height):
        return camera
    origin = f"that of the run {path}, with the object ({earlier.origin})"
    return replace(earlier, origin=origin, assumed=False)


def _of_run(folder: Path) -> KnownObject:
    import trimesh  # slow to import

    run = RunReader(folder)
    try:
        model = load_model(run.mesh_folder)
    except InputError as error:
        raise InputError(f"{_OBJECT}{folder} cannot be tracked by: {error}") from error
    if wrong := what_is_wrong(trimesh.Trimesh(model.vertices, model.faces, process=False)):
        raise InputError(f"{_OBJECT}{folder}: its mesh {wrong}; track again.")
    if not any(record.status is Status.TRACKED for record in run.frames):
        raise InputError(
            f"{_OBJECT}{folder}: no frame of that run was tracked, so its mesh is a guess; give one in which the "
            "object was seen to turn."
        )
    return KnownObject(f"the object of {folder}", model, run.camera)


def _of_mesh(path: Path) -> KnownObject:
    mesh = sound_mesh_file(path, f"{_OBJECT}{path}", _ADVICE)
    if len(mesh.faces) > _MOST_FACES:
        raise InputError(
            f"{_OBJECT}{path} has {len(mesh.faces):,} faces; simplify it to {_MOST_FACES:,} or fewer, a tenth of "
            "which is enough to track by."
        )
    model = _model_of(mesh)
    if not len(model.faces):
        raise InputError(f"{_OBJECT}{path} holds only triangles without area; {_ADVICE}.")
    return KnownObject(f"the object of {path}", model)


def _model_of(mesh: trimesh.Trimesh) -> ObjectModel:
    """A mesh with an atlas in which every face has texels of its own, and its colours, as far as it has any."""
    corners = np.asarray(mesh.faces, np.int64)
    uvs, picture = _texture(mesh, corners)
    colours = _colours(mesh, corners)
    vertices, faces, kept, turned = _orient_outward(mesh)

    def kept_corners(values: NDArray[np.float64]) -> NDArray[np.float64]:
        values = values[kept]
        return np.where(turned[:, None, None], values[:, ::-1], values)

    uvs = None if uvs is None else kept_corners(uvs)
    if uvs is not None and picture is not None and shares_no_texel(uvs):
        face_uvs, texture = uvs, picture
    else:
        face_uvs = face_atlas(len(faces))
        texels = TexelMap.of(torch.from_numpy(face_uvs).float(), _side(len(faces)))
        if uvs is not None and picture is not None:
            place = torch.from_numpy(on_faces(uvs, texels) % 1.0).float()
            layers = torch.from_numpy(picture.transpose(2, 0, 1).copy()).float()
            seen = sample_texture(layers, place).double().numpy()
        else:
            plain = np.full((len(faces), 3, 3), float(_GREY))
            seen = on_faces(plain if colours is None else kept_corners(colours), texels)
        texture = paint_faces(seen, texels)
    known = float(picture is not None or colours is not None)
    return ObjectModel(
        vertices, faces, face_uvs, texture, np.full(texture.shape[:2], known, np.float32),
        np.zeros((1, 1, 1), np.float32),
    )  # fmt: skip


def _orient_outward(
    mesh: trimesh.Trimesh,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Merge vertices at the same place, as a border is drawn as an outline, and turn all faces outward.

    Returns:
        Vertices ``(V, 3)`` and faces ``(F, 3)``, which of the mesh's faces these are, and whether each is turned round.
    """
    import trimesh  # slow to import

    size = float(np.ptp(mesh.vertices, axis=0).max())
    _, first, inverse = np.unique(
        np.round(mesh.vertices / (1e-6 * size)), axis=0, return_index=True, return_inverse=True
    )
    faces = inverse.reshape(-1)[np.asarray(mesh.faces)]
    solid = trimesh.Trimesh(np.asarray(mesh.vertices, np.float64)[first], faces, process=False)
    kept = np.flatnonzero(solid.nondegenerate_faces())
    solid = trimesh.Trimesh(solid.vertices, faces[kept], process=False)
    solid.fix_normals()
    outward = np.asarray(solid.faces, np.int64)
    turned = (outward != faces[kept]).any(1)
    return np.asarray(solid.vertices, np.float64), outward, kept, turned


def _side(faces: int) -> int:
    cells = np.sqrt(faces / 2)
    return int(np.clip(_TEXELS_OF_A_FACE * cells, _SMALLEST_TEXTURE, _LARGEST_TEXTURE))


def _texture(
    mesh: trimesh.Trimesh, faces: NDArray[np.int64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.uint8] | None]:
    """Texture coordinates ``(F, 3, 2)``, v down, and the image ``(H, W, 3)``; None if there is none."""
    material = getattr(mesh.visual, "material", None)
    uvs = getattr(mesh.visual, "uv", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if uvs is None or image is None or len(uvs) != len(mesh.vertices) or not np.isfinite(uvs).all():
        return None, None
    corner = np.asarray(uvs, np.float64)[faces]
    return np.stack([corner[..., 0], 1 - corner[..., 1]], 2), np.asarray(image.convert("RGB"))


def _colours(mesh: trimesh.Trimesh, faces: NDArray[np.int64]) -> NDArray[np.float64] | None:
    """``(F, 3, 3)`` in [0, 255] of the faces' corners; None if the file has none, or one for all."""
    import trimesh  # slow to import

    if not isinstance(mesh.visual, trimesh.visual.ColorVisuals) or mesh.visual.kind not in ("vertex", "face"):
        return None
    colours = np.asarray(mesh.visual.vertex_colors, np.float64)[:, :3]
    return colours[faces] if np.ptp(colours, axis=0).any() else None
