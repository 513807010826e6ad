"""Writing clips with ground truth as a data set in the BOP format.

Every clip becomes a scene with one object, every frame the image of its index. Lengths are in millimetres, axes and
pixels are those of this package: BOP's model-to-camera pose is ``T_cam_obj``, and pixel (0, 0) is the centre of
the top-left pixel in both. Format: https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md.

What lies beyond the image's border is not counted as part of the silhouette, unlike in the official data.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist
from trimesh.exchange.ply import export_ply

from tracking3d.errors import InputError
from tracking3d.geometry.alignment import is_rigid
from tracking3d.results.files import write_atomic, write_image, write_mask, writing
from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.truth import MeshFile, Truth

LEAST_VISIBLE = 0.1
"""Share of the silhouette that must be seen for a frame to be a test target (BOP Challenge 2019)."""

Entry = dict[str, Any]


def write_bop(folder: Path, truths: Sequence[Truth], split: str = "test") -> None:
    """Write clips as one data set.

    Scenes are numbered from 1 in the order of ``truths``, objects from 1 in the order of their first scene; clips of
    one mesh file are of one object. A frame has annotations if both its pose and its mask are known. JPEG and PNG
    frames and depth are copied, other frames converted to PNG.

    Args:
        folder: Made if absent; files of the same names are overwritten.
        truths: Each with camera, mesh and the length of its unit.
        split: Name of the folder of scenes; targets are written for ``test`` only.

    Raises:
        InputError: If a clip lacks one of these, or a file of it cannot be read.
        OutputError: If the data set cannot be written.
    """
    objects: dict[tuple[Path, float, float], int] = {}
    info, targets = {}, []
    for scene_id, truth in enumerate(truths, 1):
        mesh, millimetres = _required(truth)
        key = mesh.path.resolve(), mesh.scale, millimetres
        if key not in objects:
            objects[key] = len(objects) + 1
            info[objects[key]] = _write_model(folder / "models", objects[key], truth, mesh, millimetres)
        scene = folder / split / f"{scene_id:06d}"
        gt_info = _write_scene(scene, truth, objects[key], millimetres)
        targets += [
            {"scene_id": scene_id, "im_id": im_id, "obj_id": objects[key], "inst_count": 1}
            for im_id, entries in gt_info.items()
            if entries[0]["visib_fract"] >= LEAST_VISIBLE
        ]
    _write_json(folder / "models" / "models_info.json", info)
    if split == "test":
        _write_json(folder / "test_targets_bop19.json", targets)


def _required(truth: Truth) -> tuple[MeshFile, float]:
    if truth.camera is None or truth.mesh is None or truth.millimetres is None:
        raise InputError(
            f"The clip {truth.name} lacks a camera, a mesh or its unit in millimetres; BOP needs all of them."
        )
    return truth.mesh, truth.millimetres


def _write_scene(scene: Path, truth: Truth, obj_id: int, millimetres: float) -> dict[int, list[Entry]]:
    """Write one scene; the entries of its scene_gt_info.json."""
    assert truth.camera is not None
    for part in ("rgb", "mask", "mask_visib", *(["depth"] if truth.depth else [])):
        _make(scene / part)
    cameras: dict[int, Entry] = {}
    gt: dict[int, list[Entry]] = {}
    gt_info: dict[int, list[Entry]] = {}
    for n, file in enumerate(truth.frames):
        _write_frame(scene / "rgb", n, file)
        depth = truth.depth.get(n)
        scale = depth.scale * millimetres if depth else 1.0
        cameras[n] = {"cam_K": truth.camera.K.ravel().tolist(), "depth_scale": scale}
        known = depth.read() > 0 if depth else None
        if depth:
            _copy(depth.path, scene / "depth" / f"{n:06d}.png")
        masks = _masks(truth, n)
        if n not in truth.T_cam_obj or not is_rigid(truth.T_cam_obj[n]) or masks is None:
            continue
        for part, mask in zip(("mask", "mask_visib"), masks, strict=True):
            write_mask(scene / part / f"{n:06d}_000000.png", mask)
        pose = truth.T_cam_obj[n]
        rotation, translation = pose[:3, :3].ravel(), pose[:3, 3] * millimetres
        gt[n] = [{"cam_R_m2c": rotation.tolist(), "cam_t_m2c": translation.tolist(), "obj_id": obj_id}]
        gt_info[n] = [_gt_info(*masks, known)]
    _write_json(scene / "scene_camera.json", cameras)
    _write_json(scene / "scene_gt.json", gt)
    _write_json(scene / "scene_gt_info.json", gt_info)
    return gt_info


def _masks(truth: Truth, n: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """The whole silhouette and its visible part; each stands in for the other if unknown."""
    whole, seen = truth.masks.get(n), truth.visible_masks.get(n)
    if whole is None and seen is None:
        return None
    masks = [mask.read() for mask in (whole, seen) if mask is not None]
    return masks[0], masks[-1]


def _gt_info(mask: NDArray[np.bool_], visible: NDArray[np.bool_], known: NDArray[np.bool_] | None) -> Entry:
    count, seen = int(mask.sum()), int(visible.sum())
    return {
        "bbox_obj": _bop_box(mask) if seen else [-1, -1, -1, -1],
        "bbox_visib": _bop_box(visible),
        "px_count_all": count,
        "px_count_valid": 0 if known is None else int((mask & known).sum()),
        "px_count_visib": seen,
        "visib_fract": seen / count if count else 0.0,
    }


def _bop_box(mask: NDArray[np.bool_]) -> list[int]:
    """First column and row of a mask, and how far it is to the last ones, as the official tools have it."""
    if not mask.any():
        return [-1, -1, -1, -1]
    y, x = np.nonzero(mask)
    return [int(x.min()), int(y.min()), int(np.ptp(x)), int(np.ptp(y))]


def _write_frame(folder: Path, n: int, file: Path) -> None:
    suffix = file.suffix.lower()
    if suffix in (".png", ".jpg", ".jpeg"):
        _copy(file, folder / f"{n:06d}{'.png' if suffix == '.png' else '.jpg'}")
    else:
        write_image(folder / f"{n:06d}.png", read_image(file))


def _write_model(folder: Path, obj_id: int, truth: Truth, file: MeshFile, millimetres: float) -> Entry:
    """Write a mesh with the colours of its vertices; its entry of models_info.json."""
    mesh = file.read().apply_scale(millimetres)
    if isinstance(mesh.visual, trimesh.visual.TextureVisuals):
        mesh.visual = mesh.visual.to_color()
    _make(folder)
    data = export_ply(mesh, encoding="ascii", vertex_normal=True)
    write_atomic(folder / f"obj_{obj_id:06d}.ply", data if isinstance(data, bytes) else data.encode())
    lowest, size = mesh.bounds[0].tolist(), mesh.extents.tolist()
    entry: Entry = {"diameter": _diameter(mesh.vertices)}
    entry |= {f"min_{axis}": value for axis, value in zip("xyz", lowest, strict=True)}
    entry |= {f"size_{axis}": value for axis, value in zip("xyz", size, strict=True)}
    symmetries = list(_symmetries(truth.symmetries, millimetres))
    return entry | ({"symmetries_discrete": symmetries} if symmetries else {})


def _diameter(vertices: NDArray[np.float64]) -> float:
    """The largest distance of two vertices; both are corners of the convex hull."""
    with suppress(QhullError):  # a flat mesh has no hull
        vertices = vertices[ConvexHull(vertices).vertices]
    return float(pdist(vertices).max())


def _symmetries(transforms: NDArray[np.float64], millimetres: float) -> Iterator[list[float]]:
    """Row by row, without the identity, which BOP implies."""
    for transform in transforms:
        if not np.allclose(transform, np.eye(4)):
            scaled = transform.copy()
            scaled[:3, 3] *= millimetres
            yield scaled.ravel().tolist()


def _make(folder: Path) -> None:
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


def _copy(source: Path, target: Path) -> None:
    if not source.is_file():
        raise InputError(f"There is no file {source}; restore it.")
    with writing(target):
        shutil.copyfile(source, target)


def _write_json(file: Path, document: Any) -> None:
    write_atomic(file, json.dumps(document, indent=1).encode() + b"\n")
