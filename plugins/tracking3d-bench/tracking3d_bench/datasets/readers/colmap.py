"""Camera poses of a COLMAP model, text or binary, with the object as the world.

COLMAP's poses map world to camera with OpenCV's axes, so they are ``T_cam_obj`` if the model is of the object alone.
The world's origin is moved to the median of the model's points: COLMAP leaves it near the cameras, and if these are
close together, that is many times their distances away from the object. ``cameras``, ``rigs`` and ``frames`` tell
nothing more about poses.
Format: https://colmap.github.io/format.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers.colmap_points import read_points
from tracking3d_bench.datasets.readers.text_files import read_text
from tracking3d_bench.datasets.truth import Truth

_COUNT = struct.Struct("<Q")
_POSE = struct.Struct("<I7dI")
"""Image, quaternion w, x, y, z, translation, camera."""
_POINT_SIZE = 24
"""Bytes of two doubles and an integer."""

Poses = dict[str, NDArray[np.float64]]
"""World to camera ``(4, 4)`` by the image's name."""


def answers_from_colmap(folder: Path, truth: Truth) -> Answers:
    """The registered images' poses; frames that are not registered are lost.

    Args:
        folder: A model, or a folder of models such as ``sparse`` with ``0``, ``1`` and so on; of several the one
            with most images counts, since each has coordinates of its own.
        truth: The clip; images are matched to frames by name without folder and suffix.

    Raises:
        InputError: If there is no model, it is damaged, or it has no image with the name of a frame.
    """
    models = {file: _read_images(file) for file in _models(folder)}
    if not models:
        raise InputError(
            f"{folder} holds no COLMAP model; give the folder of images.bin or images.txt, or its parent."
        )
    index = {name: n for n, name in enumerate(truth.names)}
    largest = max(models, key=lambda file: len(models[file]))
    T_world_obj = np.eye(4)
    if len(points := read_points(largest.parent)):
        T_world_obj[:3, 3] = np.median(points, axis=0)
    stems = {PurePosixPath(name).stem: pose @ T_world_obj for name, pose in models[largest].items()}
    poses = {index[stem]: pose for stem, pose in stems.items() if stem in index}
    if not poses:
        raise InputError(
            f"The COLMAP model {folder} has no image with the name of a frame of the clip {truth.name}, such as "
            f"{truth.names[0]}; give the model of this clip."
        )
    frames = range(len(truth.frames))
    return Answers(
        origin=folder,
        asked=frames,
        answered=frozenset(frames),
        T_cam_obj=dict(sorted(poses.items())),
        lost=frozenset(frames) - poses.keys(),
    )


def _models(folder: Path) -> Iterator[Path]:
    """The images file of each model in ``folder``, ``folder/sparse``, or one level below either."""
    for parent in (folder, folder / "sparse"):
        if parent.is_dir():
            for place in (parent, *sorted(path for path in parent.iterdir() if path.is_dir())):
                files = [place / f"images.{suffix}" for suffix in ("bin", "txt")]
                yield from [file for file in files if file.is_file()][:1]


def _read_images(file: Path) -> Poses:
    return _read_binary(file) if file.suffix == ".bin" else _read_lines(file)


def _read_lines(file: Path) -> Poses:
    poses: Poses = {}
    lines = enumerate(read_text(file).splitlines(), 1)
    for number, line in lines:
        if not line.strip() or line.startswith("#"):
            continue
        try:
            _, *pose, _, name = line.split(maxsplit=9)
            values = np.array([float(value) for value in pose]).reshape(7)
        except ValueError as error:
            raise InputError(
                f"Line {number} of {file} is not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; export the model again."
            ) from error
        poses[name.strip()] = _pose(values, f"Line {number} of {file}")
        next(lines, None)  # the image's points, which may be an empty line
    return poses


def _read_binary(file: Path) -> Poses:
    try:
        data = file.read_bytes()
        (count,) = _COUNT.unpack_from(data)
        poses: Poses = {}
        position = _COUNT.size
        for _ in range(count):
            image, *values, _ = _POSE.unpack_from(data, position)
            position += _POSE.size
            end = data.index(b"\0", position)
            name = data[position:end].decode()
            (points,) = _COUNT.unpack_from(data, end + 1)
            position = end + 1 + _COUNT.size + _POINT_SIZE * points
            if position > len(data):
                raise ValueError("it is truncated")
            poses[name] = _pose(np.array(values), f"Image {image} of {file}")
    except (OSError, ValueError, struct.error) as error:
        raise InputError(
            f"{file} cannot be read as COLMAP's images ({error}); export the model again."
        ) from error
    return poses


def _pose(values: NDArray[np.float64], label: str) -> NDArray[np.float64]:
    """``(4, 4)`` from quaternion w, x, y, z and translation."""
    w, x, y, z, *translation = values
    if not np.isfinite(values).all() or abs(np.linalg.norm(values[:4]) - 1) > 0.01:
        raise InputError(f"{label} has no unit quaternion or no finite translation; export the model again.")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    T[:3, 3] = translation
    return T
