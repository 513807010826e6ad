"""Files of the BOP format: poses, cameras and symmetries of objects. Lengths are millimetres.

Source: https://github.com/thodan/bop_toolkit, ``docs/bop_datasets_format.md`` and ``bop_toolkit_lib/misc.py``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.geometry.alignment import is_rigid, nearest_rigid
from tracking3d_bench.datasets.json_files import read_json

LARGEST_STEP = 0.01
"""``max_sym_disc_step``: how far, in diameters, a point of the object may move from one turn about an axis of
symmetry to the next. The BOP challenge's value."""


@dataclass(frozen=True, eq=False)
class Annotation:
    """One object in one image.

    Attributes:
        object_id: Number of its model.
        instance: Position in the image's list; masks are named by it.
        T_cam_obj: ``(4, 4)``.
    """

    object_id: int
    instance: int
    T_cam_obj: NDArray[np.float64]


def read_scene_gt(file: Path) -> dict[int, list[Annotation]]:
    """Read ``scene_gt.json``: the objects of each image, by the image's number.

    Raises:
        InputError: If it is not such a file, or a rotation is none.
    """
    return {
        number: [_annotation(entry, n, file, number) for n, entry in enumerate(entries)]
        for number, entries in _by_number(file, list).items()
    }


def read_scene_camera(file: Path) -> dict[int, tuple[Any, float]]:
    """Read ``scene_camera.json``: K, and millimetres per count of the depth image, by the image's number.

    ``K`` is as it stands in the file; see `tracking3d_bench.datasets.cameras.camera_from_matrix`.

    Raises:
        InputError: If it is not such a file.
    """
    cameras = {}
    for number, entry in _by_number(file, dict).items():
        scale = entry.get("depth_scale", 1.0)
        if "cam_K" not in entry or not isinstance(scale, int | float) or not 0 < scale < math.inf:
            raise InputError(f"{file}: image {number} needs cam_K and a positive depth_scale; correct it.")
        cameras[number] = entry["cam_K"], float(scale)
    return cameras


def read_symmetries(file: Path, object_id: int, largest_step: float = LARGEST_STEP) -> NDArray[np.float64]:
    """Read an object's symmetries from ``models_info.json``.

    An axis of continuous symmetry becomes ``ceil(pi / largest_step)`` equal turns about it, combined with every
    discrete symmetry.

    Returns:
        ``(S, 4, 4)``, the identity first.

    Raises:
        InputError: If the file does not know the object, or a symmetry is no rigid transform.
    """
    info = _by_number(file, dict).get(object_id)
    if info is None:
        raise InputError(f"{file} has no object {object_id}; restore it.")
    try:
        discrete = [
            np.eye(4),
            *np.reshape(info.get("symmetries_discrete", []), (-1, 4, 4)).astype(np.float64),
        ]
        continuous = [
            turn
            for axis in info.get("symmetries_continuous", [])
            for turn in _turns(
                np.asarray(axis["axis"], float), np.asarray(axis["offset"], float), largest_step
            )
        ] or [np.eye(4)]
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"{file}: the symmetries of object {object_id} cannot be read; correct them."
        ) from error
    transforms = np.stack([turn @ symmetry for symmetry in discrete for turn in continuous])
    if not all(is_rigid(transform) for transform in transforms):
        raise InputError(f"{file}: a symmetry of object {object_id} is not a rigid transform; correct it.")
    return transforms


def _turns(
    axis: NDArray[np.float64], offset: NDArray[np.float64], largest_step: float
) -> NDArray[np.float64]:
    """``(S, 4, 4)`` equal turns about the line through ``offset`` along ``axis``, the identity first."""
    length = np.linalg.norm(axis)
    if not length > 0:
        raise ValueError("an axis has no direction")
    count = math.ceil(math.pi / largest_step)
    angles = 2 * np.pi * np.arange(count) / count
    turns = np.tile(np.eye(4), (count, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * axis / length).as_matrix()
    turns[:, :3, 3] = offset - turns[:, :3, :3] @ offset
    return turns


def _annotation(entry: Any, instance: int, file: Path, image: int) -> Annotation:
    where = f"{file}: image {image}"
    try:
        T = np.eye(4)
        T[:3, :3] = np.reshape(entry["cam_R_m2c"], (3, 3))
        T[:3, 3] = entry["cam_t_m2c"]
        object_id = int(entry["obj_id"])
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(
            f"{where} needs obj_id, cam_R_m2c (9 numbers) and cam_t_m2c (3 numbers); correct that entry."
        ) from error
    if (rigid := nearest_rigid(T, file)) is None:
        raise InputError(f"{where}: cam_R_m2c of object {object_id} is not a rotation; correct it.")
    return Annotation(object_id, instance, rigid)


def _by_number(file: Path, kind: type) -> dict[int, Any]:
    """The entries of a file whose keys are numbers and whose values are of one kind."""
    try:
        entries = {int(key): value for key, value in read_json(file).items()}
    except ValueError as error:
        raise InputError(f"{file}: its keys must be numbers; restore it.") from error
    for number, value in entries.items():
        if not isinstance(value, kind):
            raise InputError(
                f"{file}: entry {number} is not a {'list' if kind is list else 'mapping'}; restore it."
            )
    return entries
