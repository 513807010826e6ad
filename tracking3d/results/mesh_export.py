"""The object as OBJ with MTL and texture.png, as GLB, and exactly as features.npz; and back.

Coordinates are the object's own, unchanged, in an arbitrary unit; their y axis points down. In the GLB a node above
the mesh turns them to glTF's axes, y up, so that viewers show the object as it stood in the video. An OBJ has no such
node: there, viewers that take y as up show it upside down until it is turned.

The atlas wraps in u and is clamped in v. OBJ viewers and glTF repeat a texture beyond its edge, which is
exactly the wrap; for glTF the clamp in v is written as well. OBJ cannot say that: there the outermost half
texel at the two poles mixes with the opposite edge.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image as PillowImage

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.gltf_axes import OBJECT_NODE, UNSEEN_MATERIAL, UPRIGHT_NODE, UPRIGHT_ROTATION
from tracking3d.results.files import first_problem, image_file, write_atomic, write_together
from tracking3d.results.layout import ARBITRARY, FEATURES, GLB, MTL, OBJ, OUT, TEXTURE
from tracking3d.runtime.array_files import ArrayFile
from tracking3d.runtime.interruption import interrupts_deferred

if TYPE_CHECKING:
    import trimesh

_FARTHEST = 1e12  # of a vertex; float32 can square it
_REPEAT, _CLAMP, _LINEAR, _MIPMAP = 10497, 33071, 9729, 9987  # glTF's constants
_VERTICES, _INDICES = 34962, 34963  # so are these, for what a buffer holds
_ROUNDING = 2.0**-20  # of texture coordinates; far less than a texel


def export_mesh(folder: Path, model: ObjectModel, unit: str = ARBITRARY) -> None:
    """Write the mesh files of a run: all of them, or none if the program is interrupted.

    If one cannot be made, those before it are written nevertheless.

    Args:
        folder: The run folder, or one within.
        model: The object.
        unit: Its unit of length, ``arbitrary`` or ``metre``.

    Raises:
        OutputError: If one cannot be written.
    """
    files: dict[Path, bytes] = {}
    problem = first_problem(lambda: files.update(mesh_files(folder, model, unit)))
    with interrupts_deferred():
        write_together(files)
    if problem is not None:
        raise problem


def mesh_files(folder: Path, model: ObjectModel, unit: str) -> Iterator[tuple[Path, bytes]]:
    """The paths and contents that `export_mesh` writes."""
    texture = _Texture(model)
    for name, data in obj_files(model, f"object coordinates, OpenCV axes, unit: {unit}", texture).items():
        yield folder / name, data
    yield folder / GLB, glb_file(model, texture=texture, unit=unit)
    yield folder / FEATURES, _features_file(model)


def _features_file(model: ObjectModel) -> bytes:
    """The exact model, without its texture image."""
    exact = io.BytesIO()
    seen: dict[str, Any] = {} if model.seen is None else {"seen": model.seen}
    np.savez_compressed(
        exact,
        vertices=model.vertices,
        faces=model.faces,
        face_uvs=model.face_uvs,
        texture_weight=model.texture_weight,
        features=model.features,
        **seen,
    )
    return exact.getvalue()


class _Texture:
    """A model's texture as a file; trimesh would encode it once for each format.

    Attributes:
        format: As Pillow has it.
    """

    format = "PNG"

    def __init__(self, model: ObjectModel) -> None:
        self._file = image_file(model.texture)

    def save(self, fp: BinaryIO, format: str | None = None) -> None:
        """What trimesh asks of an image."""
        fp.write(self._file)


def obj_files(model: ObjectModel, header: str, texture: _Texture | None = None) -> dict[str, bytes]:
    """The model as OBJ with MTL and texture: contents by file name.

    Args:
        model: The object.
        header: Which coordinates these are, for who opens the file.
        texture: Its texture, if it is encoded already.
    """
    import trimesh  # slow to import
    from trimesh.exchange.obj import export_obj

    simple = trimesh.visual.material.SimpleMaterial(
        texture or _Texture(model),
        diffuse=(255, 255, 255),
        ambient=(255, 255, 255),
        specular=(0, 0, 0),
        name=Path(TEXTURE).stem,
    )
    with interrupts_deferred():  # trimesh would catch them, and leave out normals or texture instead
        text, files = export_obj(
            split_mesh(model, simple),
            include_normals=True,
            return_texture=True,
            digits=9,
            mtl_name=MTL,
            header=f"tracking3d: {header}",
        )
    return {OBJ: group_faces(text, find_seen_faces(model)).encode(), **files}


def glb_file(
    model: ObjectModel,
    finish: Callable[[dict[str, Any]], None] | None = None,
    texture: _Texture | None = None,
    unit: str = ARBITRARY,
    **more: Any,
) -> bytes:
    """The model as GLB, turned upright; faces that no frame has shown come last, as a primitive of their own.

    Args:
        model: The object.
        finish: Changes the glTF tree once this module is done with it; see trimesh's ``tree_postprocessor``.
        texture: Its texture, if it is encoded already.
        unit: Unit of length of the model, ``arbitrary`` or ``metre``; it is noted in ``asset.extras``.
        more: Further arguments of trimesh's ``export_glb``.
    """
    import trimesh  # slow to import
    from trimesh.exchange.gltf import export_glb

    pbr = trimesh.visual.material.PBRMaterial(
        name=Path(TEXTURE).stem,
        baseColorTexture=texture or _Texture(model),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )

    ordered, seen = sort_seen_first(model)

    def finish_all(tree: dict[str, Any]) -> None:
        split_primitive(tree, seen)
        _finish_gltf(tree)
        tree["asset"]["extras"] = unit_note(unit)
        if finish is not None:
            finish(tree)

    with interrupts_deferred():  # see `obj_files`
        data: bytes = export_glb(
            split_mesh(ordered, pbr), include_normals=True, tree_postprocessor=finish_all, **more
        )
    return data


def unit_note(unit: str) -> dict[str, str]:
    """What a format whose unit is the metre says of lengths in ``unit``.

    Args:
        unit: ``arbitrary`` or ``metre``.
    """
    if unit != ARBITRARY:
        return {"unit": unit}
    note = "The size of the object is unknown: lengths are in an arbitrary unit, not in metres."
    return {"unit": "unknown", "note": note}


def split_mesh(model: ObjectModel, material: trimesh.visual.material.Material) -> trimesh.Trimesh:
    """The model with one texture coordinate a vertex: vertices are doubled only at the seams of the atlas.

    Corners are one vertex if they share their position, in single precision as a GLB holds it, and their texture
    coordinate up to rounding.
    Faces keep their order. Texture coordinates have trimesh's origin, the lower left. Normals are those of
    the unsplit mesh, so that the seam does not show.
    """
    import trimesh  # slow to import

    corner, face_uvs = model.faces.ravel(), model.face_uvs.reshape(-1, 2)
    places = model.vertices[corner].astype(np.float32)
    distinct = np.concatenate([places, np.round(face_uvs / _ROUNDING)], axis=1)
    _, first, inverse = np.unique(distinct, axis=0, return_index=True, return_inverse=True)
    vertex = corner[first]
    whole = trimesh.Trimesh(model.vertices, model.faces, process=False)
    uv = np.stack([face_uvs[first, 0], 1.0 - face_uvs[first, 1]], axis=1)
    attributes: dict[str, Any] = (
        {} if model.seen is None else {"_seen": model.seen[vertex].astype(np.float32)}
    )
    return trimesh.Trimesh(
        model.vertices[vertex],
        inverse.reshape(-1, 3),
        vertex_normals=whole.vertex_normals[vertex],
        visual=trimesh.visual.TextureVisuals(uv, material=material),
        vertex_attributes=attributes,
        process=False,
    )


def load_mesh(folder: Path) -> trimesh.Trimesh:
    """Read the OBJ of a run: vertices, faces in the model's order, and the texture as its visual.

    Raises:
        InputError: If the run has no mesh, or it cannot be read.
    """
    import trimesh  # slow to import

    path = _existing(folder / OBJ)
    try:
        mesh = trimesh.load_mesh(path, process=False, maintain_order=True)
        fault = _mesh_fault(mesh)
    except Exception as error:  # trimesh raises whatever its loaders raise
        raise InputError(
            f"The mesh {path} cannot be read ({error}); track again into another {OUT}."
        ) from error
    if fault:
        raise InputError(f"The mesh {path} {fault}; track again with another --out.")
    return mesh


def _mesh_fault(mesh: Any) -> str:
    """Why that is no surface, or nothing."""
    import trimesh  # slow to import

    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return "has no faces"
    return _surface_fault(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _surface_fault(vertices: NDArray, faces: NDArray) -> str:
    """Why vertices ``(V, 3)`` and faces ``(F, 3)`` are no surface, or nothing."""
    if not (np.abs(vertices) < _FARTHEST).all():
        return "has vertices with invalid coordinates"
    return "has faces with missing vertices" if not 0 <= faces.min() <= faces.max() < len(vertices) else ""


def load_model(folder: Path) -> ObjectModel:
    """Read the exact model of a run.

    Raises:
        InputError: If the run has no mesh, or it cannot be read.
    """
    path = _existing(folder / FEATURES)
    try:
        with ArrayFile(path) as arrays, PillowImage.open(folder / TEXTURE) as image:
            texture: NDArray[np.uint8] = np.asarray(image.convert("RGB"))
            model = ObjectModel(texture=texture, **{name: arrays.read(name) for name in arrays.names})
            fault = _model_fault(model)
    except Exception as error:  # a damaged archive raises almost anything
        raise InputError(
            f"The model {path} cannot be read ({error}); track again into another {OUT}."
        ) from error
    if fault:
        raise InputError(f"The model {path} {fault}; track again into another {OUT}.")
    return model


def _model_fault(model: ObjectModel) -> str:
    """Why that is no textured surface, or nothing."""
    vertices, faces, uvs = model.vertices, model.faces, model.face_uvs
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        return "has no faces"
    if vertices.ndim != 2 or vertices.shape[1] != 3 or uvs.shape != (len(faces), 3, 2):
        return (
            f"has vertices {vertices.shape} and texture coordinates {uvs.shape}, which do not fit its faces"
        )
    if not np.isfinite(uvs).all():
        return "has texture coordinates that are not finite"
    return _surface_fault(vertices, faces)


def restore_texture(folder: Path) -> bool:
    """If the texture image of a run is missing, take it from the GLB, if that has it.

    Returns:
        Whether that was done.

    Raises:
        OutputError: If it cannot be written.
    """
    import trimesh  # slow to import

    path = folder / TEXTURE
    if (path.is_file() and path.stat().st_size) or not (folder / GLB).is_file():
        return False
    try:
        scene: Any = trimesh.load_scene(folder / GLB, process=False)
        materials = [part.visual.material for part in scene.geometry.values()]
        (texture,) = [one.baseColorTexture for one in materials if one.baseColorTexture is not None]
        image = np.asarray(texture.convert("RGB"), dtype=np.uint8)
    except Exception:  # the GLB is damaged too
        return False
    write_atomic(path, image_file(image))
    return True


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise InputError(
            f"{path.parent} holds no {path.name}; the run is not finished, or finished without a mesh."
        )
    return path


def _finish_gltf(tree: dict[str, Any]) -> None:
    """What trimesh does not write: the turn to glTF's axes, names, and how the texture continues beyond its edge."""
    (mesh,) = tree["meshes"]
    mesh["name"] = OBJECT_NODE
    tree["nodes"] = [
        {"name": UPRIGHT_NODE, "rotation": UPRIGHT_ROTATION, "children": [1]},
        {"name": OBJECT_NODE, "mesh": 0},
    ]
    tree["scenes"] = [{"nodes": [0]}]
    tree["samplers"] = [{"wrapS": _REPEAT, "wrapT": _CLAMP, "magFilter": _LINEAR, "minFilter": _MIPMAP}]
    for texture in tree.get("textures", []):
        texture["sampler"] = 0
    for primitive in mesh["primitives"]:
        for accessor in primitive["attributes"].values():
            tree["bufferViews"][tree["accessors"][accessor]["bufferView"]]["target"] = _VERTICES
        tree["bufferViews"][tree["accessors"][primitive["indices"]]["bufferView"]]["target"] = _INDICES


UNSEEN = UNSEEN_MATERIAL
"""Name of the group, material or subset of the faces that no frame has shown."""

PALE = (0.78, 0.78, 0.76)
"""Linear RGB of its material."""

_PLACES = np.array([[1, 1, 1], [3, 1, 1], [1, 3, 1], [1, 1, 3]]) / np.array([[3], [5], [5], [5]])
_ENOUGH = 2  # of these places on a face


def find_seen_faces(model: ObjectModel) -> NDArray[np.bool_]:
    """``(F,)`` whether any frame has shown a face: at least half of the places looked at have a seen texel.

    If no texel has been seen, nobody has looked, and all faces count as seen.
    """
    weight = model.texture_weight
    if not (weight > 0).any():
        return np.ones(len(model.faces), bool)
    rows, columns = weight.shape
    uv = np.einsum("pc,fcd->fpd", _PLACES, model.face_uvs)
    column = np.floor(uv[..., 0] * columns).astype(int) % columns
    row = np.clip(np.floor(uv[..., 1] * rows).astype(int), 0, rows - 1)
    return np.asarray((weight[row, column] > 0).sum(1) >= _ENOUGH)


def find_seen_vertices(model: ObjectModel) -> NDArray[np.bool_]:
    """``(V,)`` whether a vertex belongs to a face that was seen."""
    seen = np.zeros(len(model.vertices), bool)
    seen[model.faces[find_seen_faces(model)]] = True
    return seen


def cut_unseen(model: ObjectModel) -> ObjectModel:
    """The model without the faces that no frame has shown; vertices keep their places."""
    seen = find_seen_faces(model)
    return model if seen.all() else replace(model, faces=model.faces[seen], face_uvs=model.face_uvs[seen])


def sort_seen_first(model: ObjectModel) -> tuple[ObjectModel, int]:
    """The model with the faces that were seen before the others, and how many these are."""
    seen = find_seen_faces(model)
    order = np.argsort(~seen, kind="stable")
    return replace(model, faces=model.faces[order], face_uvs=model.face_uvs[order]), int(seen.sum())


def split_primitive(tree: dict[str, Any], count: int) -> None:
    """Give the faces after the first ``count`` of a glTF's one mesh a primitive and a pale material of their own.

    Args:
        tree: The glTF.
        count: How many faces were seen; the others come after them.
    """
    (mesh,) = tree["meshes"]
    (primitive,) = mesh["primitives"]
    whole = tree["accessors"][primitive["indices"]]
    corners = 3 * count
    if corners == whole["count"]:
        return
    size = {5121: 1, 5123: 2, 5125: 4}[whole["componentType"]]
    common = {key: value for key, value in whole.items() if key not in ("min", "max")}
    start = whole.get("byteOffset", 0)
    rest = common | {"count": whole["count"] - corners, "byteOffset": start + size * corners}
    tree["materials"].append(
        {
            "name": UNSEEN,
            "pbrMetallicRoughness": {
                "baseColorFactor": [*PALE, 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": 1.0,
            },
        }
    )
    tree["accessors"].append(rest)
    unseen = primitive | {"indices": len(tree["accessors"]) - 1, "material": len(tree["materials"]) - 1}
    if corners:
        tree["accessors"][primitive["indices"]] = common | {"count": corners}
        mesh["primitives"] = [primitive, unseen]
    else:
        mesh["primitives"] = [unseen]


def group_faces(obj: str, seen: NDArray[np.bool_]) -> str:
    """An OBJ whose faces are in the groups ``seen`` and ``unseen``, in the order that they had.

    Args:
        obj: The OBJ.
        seen: ``(F,)``.
    """
    if seen.all():
        return obj
    starts = np.flatnonzero(np.diff(seen.astype(int), prepend=-1))
    names = {int(face): "seen" if seen[face] else UNSEEN for face in starts}
    lines, face = list[str](), 0
    for line in obj.split("\n"):
        if line.startswith("f "):
            if face in names:
                lines.append(f"g {names[face]}")
            face += 1
        lines.append(line)
    return "\n".join(lines)
