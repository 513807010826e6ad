"""Reading a run folder: finished, interrupted, killed, or still being written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.results import layout
from tracking3d.results.files import read_mask
from tracking3d.results.lock import is_locked
from tracking3d.results.mesh_export import load_mesh
from tracking3d.results.records import FrameRecord, latest


class RunReader:
    """A run folder as it was when each part was first asked for.

    Args:
        folder: The run folder.
        refined: Give the answers of the final refinement where there are any, else the causal ones everywhere:
            frames, masks and mesh.

    Raises:
        InputError: If it is not a run folder, or one of a newer version.
    """

    def __init__(self, folder: Path, refined: bool = True) -> None:
        self.folder = Path(folder)
        self.refined = refined
        self.description = _read_description(self.folder)

    @property
    def config(self) -> dict[str, Any]:
        """The configuration as used."""
        config: dict[str, Any] = self.description["config"]
        return config

    @cached_property
    def camera(self) -> Camera:
        """The camera of the full frame."""
        try:
            return Camera(**self.description["camera"])
        except (KeyError, TypeError) as error:
            raise InputError(
                f"{self.folder / layout.RUN} is damaged: it names no camera ({error})."
            ) from error

    @property
    def state(self) -> str:
        """``running``, ``finished``, ``interrupted`` or ``failed``; a run whose process died is the third."""
        state: str = self.description["state"]
        return "interrupted" if state == "running" and not is_locked(self.folder / layout.FRAMES) else state

    @cached_property
    def frames(self) -> list[FrameRecord]:
        """The answer for every frame, sorted by index.

        Raises:
            InputError: If a line before the last is damaged.
        """
        return latest(read_records(self.folder / layout.FRAMES), self.refined)

    @cached_property
    def _refined_frames(self) -> frozenset[int]:
        return frozenset(record.index for record in self.frames if record.refined)

    def mask_path(self, index: int) -> Path:
        """Where the answer's mask of frame ``index`` lies."""
        causal = layout.mask_path(self.folder / layout.CAUSAL, index)
        if index in self._refined_frames or not causal.is_file():
            return layout.mask_path(self.folder, index)
        return causal

    def mask(self, index: int) -> NDArray[np.bool_]:
        """The answer's mask ``(H, W)`` of frame ``index``.

        Raises:
            InputError: If there is none.
        """
        path = self.mask_path(index)
        mask = read_mask(path)
        if mask is None:
            raise InputError(
                f"The run {self.folder} has no mask of frame {index}; {path.name} is missing or damaged."
            )
        return mask

    def initial_mask(self, index: int) -> NDArray[np.bool_] | None:
        """What the mask tracker gave for frame ``index``, ``(H, W)``, or None."""
        return read_mask(layout.initial_mask_path(self.folder, index))

    @property
    def mesh_folder(self) -> Path:
        """Where the mesh that belongs to the answers lies, if there is one; see `load_mesh` and `load_model`."""
        causal = self.folder / layout.CAUSAL
        of_causal = not self._refined_frames and (causal / layout.OBJ).is_file()
        return causal if of_causal else self.folder

    def mesh(self) -> trimesh.Trimesh:
        """The textured mesh in object coordinates; see `load_mesh`."""
        return load_mesh(self.mesh_folder)


def read_records(path: Path) -> Iterator[FrameRecord]:
    """All lines of a ``frames.jsonl``, revisions included; a last line that was cut off is left out.

    Raises:
        InputError: If another line is damaged.
    """
    if not path.is_file():
        return
    damage: tuple[int, ValueError] | None = None
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            if damage:
                raise InputError(f"Line {damage[0]} of {path} is damaged ({damage[1]}); remove it.")
            try:
                yield FrameRecord.from_json(line)
            except ValueError as error:
                damage = number, error


def _read_description(folder: Path) -> dict[str, Any]:
    path = folder / layout.RUN
    if not path.is_file():
        what = "holds no run.json" if folder.is_dir() else "does not exist"
        raise InputError(f"{folder} is not a run folder: it {what}; give what --out of `tracking3d run` was.")
    try:
        description = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is damaged: it cannot be read ({error}).") from error
    if not isinstance(description, dict) or description.get("format") != layout.FORMAT:
        raise InputError(f"{folder} is not a run folder: its run.json is not one of tracking3d.")
    version = description.get("format_version")
    if not isinstance(version, int):
        raise InputError(f"{path} is damaged: it holds no format version.")
    if version > layout.FORMAT_VERSION:
        raise InputError(
            f"The run {folder} has format version {version}, newer than the "
            f"{layout.FORMAT_VERSION} that this tracking3d reads; update tracking3d."
        )
    return description
