"""Prototype meshes that the shape is deformed from, and the equirectangular atlas of their texture.

The sphere is an icosahedron whose faces are divided into f x f triangles (frequency f): ``10 f^2 + 2`` vertices,
1212 for f = 11 (paper section 3.4, "Initialization").
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.mesh_checks import sound_mesh_file

LONGEST_EDGE = 0.25
"""A user's mesh is refined until its edges are shorter than this, in units of its radius."""
MOST_FACES = 10_000
"""But not beyond this number of faces."""
_SHORT, _LONG = 0.5257311121191336, 0.85065080835204  # 1 and the golden ratio, as a vector of length 1
_ICOSAHEDRON = (
    *((x, y, 0.0) for y in (_LONG, -_LONG) for x in (-_SHORT, _SHORT)),
    *((0.0, y, z) for z in (_LONG, -_LONG) for y in (-_SHORT, _SHORT)),
    *((x, 0.0, z) for x in (_LONG, -_LONG) for z in (-_SHORT, _SHORT)),
)
_ICOSAHEDRON_FACES = (
    *((0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11)),
    *((1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8)),
    *((3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9)),
    *((4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)),
)


def icosphere(frequency: int = 11) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Unit sphere of ``10 f^2 + 2`` vertices ``(V, 3)`` and ``20 f^2`` faces ``(F, 3)``, outward oriented.

    There is a vertex at each end of the y axis, where the atlas has its poles.
    """
    sine, cosine, _ = _ICOSAHEDRON[1]  # lies in the plane z = 0
    upright = np.array(_ICOSAHEDRON) @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])
    corners: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    steps = [(i, j) for i in range(frequency + 1) for j in range(frequency + 1 - i)]
    row = {step: k for k, step in enumerate(steps)}
    weights = np.array([(frequency - i - j, i, j) for i, j in steps]) / frequency
    cells = [(row[i, j], row[i + 1, j], row[i, j + 1]) for i, j in steps if i + j < frequency]
    cells += [(row[i + 1, j], row[i + 1, j + 1], row[i, j + 1]) for i, j in steps if i + j < frequency - 1]
    for face in _ICOSAHEDRON_FACES:
        faces.append(np.array(cells) + len(steps) * len(corners))
        corners.append(weights @ upright[list(face)])
    # Vertices on shared edges are computed from both sides: merge them.
    points = np.concatenate(corners)
    _, first, inverse = np.unique(np.round(points, 6), axis=0, return_index=True, return_inverse=True)
    vertices = points[first] / np.linalg.norm(points[first], axis=1, keepdims=True)
    return vertices, inverse.reshape(-1)[np.concatenate(faces)]


def equirectangular_uvs(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Texture coordinates ``(F, 3, 2)`` of every face corner by longitude and latitude.

    The poles are on the y axis; u = 0.5 looks towards the camera (-z), u grows with x and v with y, so that the
    texture is seen upright. Faces across the seam get u beyond 1 (the texture wraps); a corner on a pole takes
    the mean u of the other two.
    """
    corner = vertices[faces]
    radius = np.linalg.norm(corner, axis=2).clip(1e-12)
    u = np.arctan2(corner[..., 0], -corner[..., 2]) / (2 * math.pi) + 0.5
    v = np.arccos((-corner[..., 1] / radius).clip(-1, 1)) / math.pi
    pole = np.hypot(corner[..., 0], corner[..., 2]) < 1e-9 * radius + 1e-12
    reference = np.where(pole, np.nan, u)
    across = np.nanmax(reference, 1) - np.nanmin(reference, 1) > 0.5
    reference = np.where(across[:, None] & (reference < 0.5), reference + 1, reference)
    u = np.where(pole, np.nanmean(reference, 1, keepdims=True), reference)
    return np.stack([u, v], 2)


def sphere(frequency: int = 11) -> Mesh:
    """The paper's prototype: a unit sphere around the origin."""
    vertices, faces = icosphere(frequency)
    return Mesh(vertices, faces, equirectangular_uvs(vertices, faces))


def ellipsoid(axes: NDArray[np.float64], rotation: NDArray[np.float64], frequency: int = 11) -> Mesh:
    """A sphere stretched by ``axes`` ``(3,)`` and turned by ``rotation`` ``(3, 3)``; its atlas is the sphere's."""
    unit = sphere(frequency)
    return Mesh((unit.vertices * axes) @ rotation.T, unit.faces, unit.face_uvs)


def from_file(path: Path) -> Mesh:
    """A user's mesh, centred and scaled to unit radius, with an atlas by longitude and latitude.

    Coarse meshes are divided into smaller faces: a face cannot bend, and a large one would fold the atlas.

    Raises:
        InputError: If the file is missing or holds no triangle mesh.
    """
    import trimesh  # slow to import

    advice = "give an OBJ, PLY, STL or GLB file"
    if not _is_file(path):
        raise InputError(f"The prototype '{path}' does not exist; give sphere, ellipsoid or a mesh file.")
    loaded = sound_mesh_file(path, f"The prototype '{path}'", advice)
    # Duplicated vertices at texture seams would tear when the shape deforms.
    solid = trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    solid.update_faces(solid.nondegenerate_faces())
    solid.remove_unreferenced_vertices()
    if len(solid.faces) == 0:
        raise InputError(f"The prototype '{path}' holds only triangles without area; {advice}.")
    if solid.is_watertight:
        solid.fix_normals()
    solid.vertices -= solid.bounds.mean(0)
    solid.vertices /= np.linalg.norm(solid.vertices, axis=1).max()
    while solid.edges_unique_length.max() > LONGEST_EDGE and 4 * len(solid.faces) <= MOST_FACES:
        solid = solid.subdivide()
    vertices, faces = np.array(solid.vertices, dtype=np.float64), np.array(solid.faces, dtype=np.int64)
    return Mesh(vertices, faces, equirectangular_uvs(vertices, faces))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False
