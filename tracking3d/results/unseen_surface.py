"""Which faces of a model no frame has shown, and how files mark them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.gltf_axes import UNSEEN_MATERIAL

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
