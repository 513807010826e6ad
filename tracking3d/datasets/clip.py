"""Clips with known truth on disk: reading and writing one folder.

::

    frames/000000.jpg|png ...    the images; their names, in natural order, are the frames
    masks/000000.png ...         0/255, where known
    poses.json                   per frame R, t and trusted; OpenCV axes, x_cam = R x_obj + t; where known
    camera.json                  K, width, height; where known
    init.json                    the first frame's bbox_xywh and mask
    info.json                    source, frames, note
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.results.files import read_mask, write_atomic, write_image, write_mask, writing
from tracking3d.video.image_sequence import images_among

POSE_CONVENTION = "T_cam_obj: x_cam = R x_obj + t; OpenCV axes"


@dataclass(frozen=True, eq=False)
class Truth:
    """What is known about a clip.

    Attributes:
        folder: The clip.
        names: Names of all frames without suffix; a frame's position here is its index in a run.
        T_cam_obj: ``(4, 4)`` pose of each frame whose pose is known and trusted, by frame index.
        masks: Mask file of each frame which has one, by frame index.
    """

    folder: Path
    names: tuple[str, ...]
    T_cam_obj: dict[int, NDArray[np.float64]]
    masks: dict[int, Path]

    def mask(self, index: int) -> NDArray[np.bool_]:
        """``(H, W)`` true mask of frame ``index``, which must be in `masks`.

        Raises:
            InputError: If its file is not a readable image.
        """
        mask = read_mask(self.masks[index])
        if mask is None:
            raise InputError(
                f"The true mask {self.masks[index]} is not a readable image; restore or remove it."
            )
        return mask


def read_truth(folder: Path) -> Truth:
    """Open a clip with known truth.

    Raises:
        InputError: If the folder or its frames are missing, it has neither masks nor poses, or its poses are
            malformed.
    """
    if not folder.is_dir():
        raise InputError(f"There is no clip folder {folder}; give the folder which holds frames/ and masks/.")
    frames = _images(folder / "frames")
    if not frames:
        raise InputError(
            f"The clip {folder} has no images in frames/; give a folder in the layout of a truth clip."
        )
    names = tuple(file.stem for file in frames)
    index = {name: n for n, name in enumerate(names)}
    masks = {index[file.stem]: file for file in _images(folder / "masks") if file.stem in index}
    poses = _read_poses(folder / "poses.json", index)
    if not masks and not poses:
        raise InputError(
            f"The clip {folder} has neither masks/ nor trusted poses in poses.json: nothing to score."
        )
    return Truth(folder, names, poses, masks)


def write_clip(
    folder: Path,
    images: NDArray[np.uint8],
    masks: NDArray[np.bool_],
    T_cam_obj: NDArray[np.float64],
    camera: Camera,
    *,
    source: str,
    note: str,
) -> None:
    """Write a clip in full, frames as PNG.

    Args:
        folder: Made if absent; files of the same names are overwritten.
        images: ``(N, H, W, 3)`` uint8 RGB.
        masks: ``(N, H, W)`` bool.
        T_cam_obj: ``(N, 4, 4)``.
        camera: The camera of all frames.
        source: Where the clip comes from.
        note: Anything worth knowing.

    Raises:
        OutputError: If it cannot be written.
    """
    names = [f"{n:06d}" for n in range(len(images))]
    poses = {
        name: {"R": pose[:3, :3].tolist(), "t": pose[:3, 3].tolist(), "trusted": True}
        for name, pose in zip(names, T_cam_obj, strict=True)
    }
    box = list(cv2.boundingRect(masks[0].astype(np.uint8)))
    documents = {
        "poses.json": {"convention": POSE_CONVENTION, "units": "object radii, about", "frames": poses},
        "camera.json": {"K": camera.K.tolist(), "width": camera.width, "height": camera.height},
        "init.json": {"frame": 0, "bbox_xywh": box, "mask": f"masks/{names[0]}.png"},
        "info.json": {"source": source, "frames": len(images), "note": note},
    }
    for part in ("frames", "masks"):
        with writing(folder / part):
            (folder / part).mkdir(parents=True, exist_ok=True)
    for name, image, mask in zip(names, images, masks, strict=True):
        write_image(folder / "frames" / f"{name}.png", image)
        write_mask(folder / "masks" / f"{name}.png", mask)
    for file, document in documents.items():
        write_atomic(folder / file, json.dumps(document, indent=1).encode() + b"\n")


def _read_poses(file: Path, index: dict[str, int]) -> dict[int, NDArray[np.float64]]:
    if not file.exists():
        return {}
    try:
        frames: dict[str, dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))["frames"]
        entries = frames.items()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{file} is not a poses file: it needs JSON with the key frames.") from error
    poses = {}
    for name, entry in entries:
        try:
            T = np.eye(4)
            T[:3, :3] = entry["R"]
            T[:3, 3] = entry["t"]
            trusted = bool(entry.get("trusted", True))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{file}: frame {name} needs R (3 x 3) and t (3); correct that entry."
            ) from error
        if not trusted or name not in index:
            continue
        if not is_rigid(T):
            raise InputError(
                f"{file}: R of frame {name} is not a rotation; correct it or mark it trusted: false."
            )
        poses[index[name]] = T
    return poses


def is_rigid(T: NDArray[np.float64], tolerance: float = 1e-3) -> bool:
    """Whether ``T`` is a finite ``(4, 4)`` rigid transform."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < tolerance and np.linalg.det(R) > 0)


def _images(folder: Path) -> list[Path]:
    """The images in ``folder`` in natural order; none if there is no such folder."""
    return images_among(folder.iterdir()) if folder.is_dir() else []
