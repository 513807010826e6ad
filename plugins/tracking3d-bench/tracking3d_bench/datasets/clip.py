"""Clips with ground truth on disk: reading and writing one folder.

::

    frames/000000.jpg|png ...    the images; their names, in natural order, are the frames
    masks/000000.png ...         0/255, the whole object, hidden parts too if they are known
    visible_masks/000000.png     0/255, only what is seen, where it differs and is known
    rough_masks/000000.png       0/255, not the truth but a tracker's input; also initial_masks/
    depth/000000.png             uint16, along the camera's z axis
    poses.json                   per frame R, t or one of them, and trusted; OpenCV axes, x_cam = R x_obj + t; units
    camera.json                  K, width, height; depth_scale: unit of the poses per count of depth, else a millimetre;
                                 told: false if a tracker is given no camera
    truth_camera.json            the true camera, if a tracker is given a wrong one
    init.json                    the first frame's bbox_xywh and mask
    mesh.obj                     the shape, in the unit of the poses
    points.npz                   positions (T, N, 2) and visible (T, N)
    info.json                    source, frames, note, millimetres per unit, symmetries (S, 4, 4), symmetry_axis

Everything but the frames may be absent.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.geometry.alignment import is_rigid, nearest_rigid
from tracking3d.geometry.camera import Camera
from tracking3d.runtime.array_files import ArrayFile
from tracking3d.testing.synthesis.convex_clips import write_clip as write_clip
from tracking3d.trackers.crops import box_of
from tracking3d.video.image_sequence import images_among
from tracking3d_bench.datasets.cameras import read_clip_camera
from tracking3d_bench.datasets.json_files import read_json
from tracking3d_bench.datasets.truth import DepthFile, MaskFile, MeshFile, PointTruth, Truth

_MILLIMETRES = {"metres": 1000.0, "centimetres": 10.0, "millimetres": 1.0}


def read_truth(folder: Path) -> Truth:
    """Open a clip with known truth.

    Raises:
        InputError: If the folder or its frames are missing, there is nothing to score, or a file of it is
            malformed.
    """
    if not folder.is_dir():
        raise InputError(f"There is no clip folder {folder}; give the folder which holds frames/ and masks/.")
    frames = _images(folder / "frames")
    if not frames:
        raise InputError(
            f"The clip {folder} has no images in frames/; give a folder with the layout of a ground-truth clip."
        )
    index = {file.stem: n for n, file in enumerate(frames)}
    masks = _masks(folder / "masks", index)
    visible_masks = _masks(folder / "visible_masks", index)
    poses, millimetres = read_poses(folder / "poses.json", index)
    points = _read_points(folder / "points.npz", len(frames))
    if not (masks or visible_masks or poses or points):
        raise InputError(
            f"The clip {folder} has neither masks/ nor trusted poses in poses.json: nothing to score."
        )
    given, true = (_camera(folder / name) for name in ("camera.json", "truth_camera.json"))
    info = _optional(folder / "info.json")
    millimetres = _length(info.get("millimetres", millimetres), folder / "info.json", "millimetres")
    mesh = folder / "mesh.obj"
    return Truth(
        name=folder.resolve().name,
        frames=tuple(frames),
        box=_initial_box(folder, visible_masks.get(0, masks.get(0))),
        camera=true or given,
        given_camera=given if true else None,
        camera_told=_is_camera_given(folder / "camera.json"),
        T_cam_obj=poses,
        masks=masks or visible_masks,
        visible_masks=visible_masks,
        depth=_depth(folder, index, millimetres),
        mesh=MeshFile(mesh) if mesh.is_file() else None,
        points=points,
        initial_masks=_masks(folder / "rough_masks", index) or _masks(folder / "initial_masks", index),
        millimetres=millimetres,
        symmetries=symmetries_of(info.get("symmetries", []), str(folder / "info.json")),
        symmetry_axis=_symmetry_axis(info.get("symmetry_axis"), folder / "info.json"),
    )


def _is_camera_given(file: Path) -> bool:
    """Whether a tracker is given the camera in ``camera.json``."""
    document = _optional(file)
    if "told" in document:
        raise InputError(
            f"{file} was written by an earlier version of tracking3d: it has the key told; rename it to given."
        )
    return document.get("given", True) is not False


def read_poses(file: Path, index: dict[str, int]) -> tuple[dict[int, NDArray[np.float64]], float | None]:
    """Read ``poses.json`` of the clip layout.

    Args:
        file: There are no poses if it does not exist.
        index: Index of each frame by its name.

    Returns:
        The trusted poses ``(4, 4)`` by frame index, NaN where the file gives no R or no t, and the length of their unit
        in millimetres, if known.

    Raises:
        InputError: If the file is not of that kind, or a trusted pose is not rigid.
    """
    if not file.exists():
        return {}, None
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        frames: dict[str, dict[str, Any]] = document["frames"]
        entries = frames.items()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file} is not a poses file: it needs JSON with the key frames.") from error
    poses = {}
    for name, entry in entries:
        try:
            R, t = entry.get("R"), entry.get("t")
            if R is None and t is None:
                raise ValueError("neither is given")
            T = np.eye(4)
            T[:3, :3] = np.eye(3) if R is None else np.asarray(R, np.float64).reshape(3, 3)
            T[:3, 3] = 0.0 if t is None else np.asarray(t, np.float64).reshape(3)
            trusted = bool(entry.get("trusted", True))
        except (AttributeError, TypeError, ValueError) as error:
            raise InputError(
                f"{file}: frame {name} needs R (3 x 3) and t (3), or one of them; correct that entry."
            ) from error
        if not trusted or name not in index:
            continue
        rigid = nearest_rigid(T, file)
        if rigid is None:
            raise InputError(
                f"{file}: R of frame {name} is not a rotation; correct it or mark it trusted: false."
            )
        T = rigid
        if R is None:
            T[:3, :3] = np.nan
        if t is None:
            T[:3, 3] = np.nan
        poses[index[name]] = T
    unit = str(document.get("units", "")).partition(" ")[0]
    return poses, _MILLIMETRES.get(unit)


def _images(folder: Path) -> list[Path]:
    """The images in ``folder`` in natural order; none if there is no such folder."""
    return images_among(folder.iterdir()) if folder.is_dir() else []


def _masks(folder: Path, index: dict[str, int]) -> dict[int, MaskFile]:
    return {index[file.stem]: MaskFile(file) for file in _images(folder) if file.stem in index}


def _optional(file: Path) -> dict[str, Any]:
    return read_json(file) if file.exists() else {}


def _camera(file: Path) -> Camera | None:
    return read_clip_camera(file) if file.exists() else None


def _depth(folder: Path, index: dict[str, int], millimetres: float | None) -> dict[int, DepthFile]:
    files = [file for file in _images(folder / "depth") if file.stem in index]
    if not files:
        return {}
    file = folder / "camera.json"
    scale = _length(_optional(file).get("depth_scale", 1 / (millimetres or 1000.0)), file, "depth_scale")
    return {index[image.stem]: DepthFile(image, scale) for image in files}


def _initial_box(folder: Path, mask: MaskFile | None) -> Box | None:
    """What init.json says of frame 0, or else the bounding box of its mask."""
    file = folder / "init.json"
    init = _optional(file)
    if "bbox_xywh" not in init or init.get("frame", 0) != 0:
        return box_of(mask.read()) if mask else None
    try:
        x, y, width, height = (float(value) for value in init["bbox_xywh"])
    except (TypeError, ValueError) as error:
        raise InputError(f"{file}: bbox_xywh must be four numbers x, y, width, height.") from error
    return x, y, width, height


def _read_points(file: Path, frames: int) -> PointTruth | None:
    if not file.exists():
        return None
    try:
        with ArrayFile(file) as arrays:
            positions, shape = arrays.header("positions").shape, arrays.header("visible").shape
            if len(shape) != 2 or shape[0] != frames or positions != (*shape, 2):
                raise InputError(
                    f"{file}: positions must be (T, N, 2) and visible (T, N) for the clip's {frames} frames, "
                    f"not {positions} and {shape}."
                )
            points = PointTruth(
                arrays.read("positions").astype(np.float64), arrays.read("visible").astype(bool)
            )
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as positions and visible ({error}); restore it.") from error
    if not np.isfinite(points.positions[points.visible]).all():
        raise InputError(f"{file}: a visible point has a position that is not finite; correct it.")
    return points


def _symmetry_axis(value: Any, file: Path) -> NDArray[np.float64] | None:
    """The unit direction ``(3,)`` in ``symmetry_axis``, or None."""
    if value is None:
        return None
    try:
        axis = np.asarray(value["direction"], dtype=np.float64).reshape(3)
    except (TypeError, ValueError, KeyError) as error:
        raise InputError(f"{file}: symmetry_axis needs a direction of 3 numbers; correct it.") from error
    length = np.linalg.norm(axis)
    if not 0 < length < np.inf:
        raise InputError(f"{file}: the direction of symmetry_axis must not be zero or infinite; correct it.")
    return axis / length


def _length(value: Any, file: Path, key: str) -> Any:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise InputError(f"{file}: {key} must be a positive number, not {value!r}.")
    return float(value)


def symmetries_of(value: Any, origin: str) -> NDArray[np.float64]:
    """Check transforms that leave an object as it is.

    Args:
        value: A list of 4 x 4 matrices, or of their 16 values row by row.
        origin: What messages call it: its file.

    Returns:
        ``(S, 4, 4)``, the identity first.

    Raises:
        InputError: If they are not rigid transforms.
    """
    try:
        transforms = np.asarray(value, dtype=np.float64).reshape(-1, 4, 4)
    except (TypeError, ValueError) as error:
        raise InputError(f"{origin}: symmetries must be a list of 4 x 4 matrices.") from error
    if not all(is_rigid(transform) for transform in transforms):
        raise InputError(f"{origin}: symmetries must be rigid transforms; correct or remove them.")
    others = [T for T in transforms if not np.allclose(T, np.eye(4))]
    return np.stack([np.eye(4), *others])
