"""A run folder that may still grow: its lines as they come, its mesh when it is there."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.camera import Camera
from tracking3d.results import layout
from tracking3d.results.files import read_mask
from tracking3d.results.mesh_export import load_model
from tracking3d.results.records import FrameRecord, latest
from tracking3d.results.run_reader import LONGEST_LINE, RunReader
from tracking3d.runtime.array_files import ArrayFile

_MOST_AT_ONCE = 2**26
"""Bytes of new lines that are taken at a time; the rest comes with the next look."""


@dataclass(eq=False)
class FollowedRun:
    """One object's run folder, read again as far as it has grown."""

    folder: Path  # the run folder
    name: str  # what the viewer calls it
    description: dict[str, Any] = field(default_factory=dict)  # what run.json says
    # the final estimates by frame index, in order
    frames: dict[int, FrameRecord] = field(default_factory=dict)
    causal: dict[int, FrameRecord] = field(default_factory=dict)  # those from before the final refinement
    model: ObjectModel | None = None  # the object, once the run has written it
    reader: RunReader = field(init=False)  # gives the masks and the camera

    def __post_init__(self) -> None:
        self._lines: list[FrameRecord] = []
        self._read = self._inode = 0
        self._model_time = 0.0
        self.reader = RunReader(self.folder)
        self.description = self.reader.description
        self.reader.camera  # noqa: B018 (a damaged one is reported before anything is shown)

    @property
    def camera(self) -> Camera:
        """The camera of the full frame, as the run knows it now."""
        return self.reader.camera

    @property
    def going_on(self) -> bool:
        """Whether the run may still grow."""
        return self.reader.state == "running"

    @property
    def refined(self) -> bool:
        """Whether there are estimates of a final refinement."""
        return any(record.refined for record in self.frames.values())

    def look_again(self) -> bool:
        """Take what has come since the last look.

        Returns:
            Whether there is anything new.

        Raises:
            InputError: If a whole line of the run is damaged.
        """
        described, grown = self._look_at_description(), self._look_at_lines()
        return self._look_at_model() or described or grown

    def mask(self, index: int, kind: str) -> NDArray[np.bool_] | None:
        """A mask ``(H, W)`` of frame ``index``: ``refined`` (the estimate), ``causal`` or ``initial``; None without."""
        if kind == "initial":
            path = layout.initial_mask_path(self.folder, index)
        else:
            path = layout.mask_path(self.folder, index)
            before = layout.mask_path(self.folder / layout.CAUSAL, index)
            if kind == "causal" and before.is_file():
                path = before
        mask = read_mask(path)
        camera = self.camera
        return mask if mask is not None and mask.shape == (camera.height, camera.width) else None

    def _look_at_description(self) -> bool:
        try:
            reader = RunReader(self.folder)
            reader.camera  # noqa: B018
        except InputError:  # it is being replaced, or somebody removes the run: what was known stays
            return False
        new = reader.description != self.description
        self.reader, self.description = reader, reader.description
        return new

    def _look_at_lines(self) -> bool:
        path = self.folder / layout.FRAMES
        try:
            stat = path.stat()
            size = stat.st_size
            # Restarted, cut back to where a stopped run goes on, or replaced by a corrected one.
            if size < self._read or stat.st_ino != self._inode:
                self._lines.clear()
                self._read, self._inode = 0, stat.st_ino
            if size == self._read:
                return False
            with path.open("rb") as file:
                file.seek(self._read)
                text = file.read(_MOST_AT_ONCE)
        except OSError:
            return False
        whole = text[: text.rfind(b"\n") + 1]
        if not whole and len(text) > LONGEST_LINE:
            raise InputError(f"{path} is damaged: one of its lines has no end; restore it.")
        self._read += len(whole)
        for line in whole.splitlines():
            try:
                self._lines.append(FrameRecord.from_line(line, path))
            except ValueError as error:
                raise InputError(f"A line of {path} is damaged ({error}); remove it.") from error
        self.frames = {record.index: record for record in latest(self._lines)}
        self.causal = {record.index: record for record in latest(self._lines, refined=False)}
        return bool(whole)

    def _look_at_model(self) -> bool:
        try:
            written = (self.folder / layout.FEATURES).stat().st_mtime
            if written == self._model_time:
                return False
            self.model = load_model(self.folder)
        except (OSError, Tracking3dError):  # not there yet, or not whole yet
            return False
        self._model_time = written
        return True


def open_followed_runs(folder: Path) -> list[FollowedRun]:
    """The runs in a folder: its own, or those of the several objects of one video.

    Raises:
        InputError: If there is none.
    """
    inner = sorted(folder.glob("object_*/"), key=lambda path: (len(path.name), path.name))
    if (folder / layout.RUN).is_file() or not inner:
        return [FollowedRun(folder, folder.name or str(folder))]
    names = picked_names(folder)
    return [
        FollowedRun(path, names.get(path.name, path.name)) for path in inner if (path / layout.RUN).is_file()
    ]


def picked_names(folder: Path) -> dict[str, str]:
    """What the objects of a run were called when they were picked, by the name of their folder."""
    try:
        picked = json.loads((folder / "picked.json").read_bytes()[:LONGEST_LINE])
        names = [str(one["name"])[:60] for one in picked["objects"]]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    return {f"object_{number}": name for number, name in enumerate(names)}


_LARGEST_STATE = 2**26  # bytes of the state's text
_LARGEST_ARRAY = 2**28
_MOST = 200_000
_ARRAY = re.compile(r"\d{8,}\.npz")


def landmarks_of_checkpoint(folder: Path) -> NDArray[np.float32] | None:
    """The landmarks ``(N, 3)`` of a run that goes on or was stopped, in object coordinates; None if none are kept.

    Args:
        folder: The run folder.
    """
    state = folder / layout.STATE
    try:
        path = state / layout.STATE_FILE
        if path.stat().st_size > _LARGEST_STATE:
            return None
        session = dict(json.loads(path.read_bytes())["session"]["dict"])
        name = session["solver"]["fields"]["known"]["fields"]["landmarks"]["file"]
        if not _ARRAY.fullmatch(name):
            return None
        with ArrayFile(state / name) as arrays:
            points = np.asarray(arrays.read("array", _LARGEST_ARRAY), np.float32)
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        RecursionError,
    ):  # of another solver, none yet, or just being replaced
        return None
    if points.ndim != 2 or points.shape[1] != 3:
        return None
    points = points[np.isfinite(points).all(axis=1)][:_MOST]
    return points if len(points) else None
