"""Reading a run folder: finished, interrupted, killed, or still being written."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import pixels
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.lens import COUNTS, Lens
from tracking3d.results import layout
from tracking3d.results.description import is_gone, stages_of
from tracking3d.results.files import is_locked, read_mask, read_occluder, read_probability
from tracking3d.results.mesh_export import load_mesh
from tracking3d.results.records import FrameRecord, latest, read_stages
from tracking3d.runtime.stage_times import StageTimes
from tracking3d.video import FrameSource, open_source

if TYPE_CHECKING:
    import trimesh

LONGEST_LINE = 2**20
"""Bytes of a line of ``frames.jsonl``; no run writes one as long."""
LONGEST_SIDE = 2**16
"""Pixels of a frame."""
_FARTHEST = 1e9  # pixels, of focal lengths and principal points
_KINDS: dict[str, Any] = {
    "state": str,
    "config": dict,
    "camera": dict,
    "selection": str | None,
    "refinement": dict | None,
    "counts": dict,
    "timings": dict,
    "skipped": list,
    "notes": list,
    "unit": dict | None,
    "scaling": dict | None,
}


class FormatError(InputError):
    """A run folder was written by a version of tracking3d with another format."""


class RunReader:
    """A run folder as it was when each part was first read.

    Args:
        folder: The run folder.
        refined: Whether frames, masks and mesh are those of the final refinement, if there is one, or all causal.
        whole: Whether a run is refused whose scaling, or the taking over of whose correction, was interrupted, so that
            its files are of two units, or of two runs.

    Raises:
        InputError: If it is not a run folder, or not whole.
        FormatError: If it was written by an earlier or a later version.
    """

    def __init__(self, folder: Path, refined: bool = True, whole: bool = True) -> None:
        self.folder = Path(folder)
        self.refined = refined
        self.description = _read_description(self.folder)
        if whole:
            _check_whole(self.folder, self.description)

    @property
    def config(self) -> dict[str, Any]:
        """The configuration as used."""
        config: dict[str, Any] = self.description.get("config", {})
        return config

    @cached_property
    def camera(self) -> Camera:
        """The camera of the full frame.

        Raises:
            InputError: If the run names none that can be.
        """
        try:
            camera = camera_from_record(self.description["camera"])
            fault = _camera_fault(camera)
        except (KeyError, TypeError, ValueError) as error:
            fault = str(error)
        if fault:
            raise InputError(
                f"{self.folder / layout.RUN} is damaged: it names no camera ({fault}); restore it."
            )
        return camera

    def camera_of(self, record: FrameRecord) -> Camera:
        """The camera that a frame's pose is of: if no focal length was given it can be another one than in the end.

        Raises:
            InputError: If there is none that can be.
        """
        camera = record.through(self.camera)
        if fault := _camera_fault(camera):
            raise InputError(
                f"{self.folder / layout.FRAMES} is damaged: frame {record.index} names no camera ({fault}); restore it."
            )
        return camera

    @property
    def unit(self) -> str:
        """The unit of lengths: ``arbitrary``, or ``metre`` if the object's size was given."""
        name = (self.description.get("unit") or {}).get("name")
        return layout.METRE if name == layout.METRE else layout.ARBITRARY

    @property
    def refinement_stages(self) -> StageTimes | None:
        """Times of the final refinement, stage by stage; None if unknown.

        Raises:
            InputError: If it is damaged.
        """
        stages = (self.description.get("refinement") or {}).get("stages")
        try:
            return None if stages is None else read_stages(stages)
        except ValueError as error:
            raise InputError(
                f"{self.folder / layout.RUN} is damaged: stages of the refinement, {error}; restore it."
            ) from error

    @property
    def state(self) -> str:
        """``running``, ``finished``, ``interrupted`` or ``failed``; a run whose process died is the third."""
        return "interrupted" if self.abandoned else str(self.description.get("state", "running"))

    @property
    def abandoned(self) -> bool:
        """Whether the process that wrote the run ended without saying so, as one that is killed does."""
        if self.description.get("state", "running") != "running":
            return False
        locked = is_locked(self.folder / layout.FRAMES)
        if locked is None:
            return is_gone(self.description.get("process") or {}) is True
        return not locked

    @property
    def state_in_words(self) -> str:
        """The state; if the run was abandoned, this is added."""
        return f"{self.state} (its process is gone)" if self.abandoned else self.state

    @property
    def not_finished(self) -> str:
        """A sentence about a run that is not finished; empty for a finished run."""
        if self.state == "finished":
            return ""
        return (
            f"The run in {self.folder} is {self.state_in_words}; frames estimated so far: {len(self.frames)}."
        )

    @cached_property
    def frames(self) -> list[FrameRecord]:
        """The estimate for every frame, sorted by index.

        Raises:
            InputError: If a line before the last is damaged.
        """
        return latest(read_records(self.folder / layout.FRAMES), self.refined)

    @cached_property
    def causal_stages(self) -> StageTimes | None:
        """Times of the causal estimates, stage by stage; an InputError as of `frames`."""
        return stages_of(latest(read_records(self.folder / layout.FRAMES), refined=False))

    @cached_property
    def _refined_frames(self) -> frozenset[int]:
        return frozenset(record.index for record in self.frames if record.refined)

    def mask_path(self, index: int) -> Path:
        """Path of the estimated mask of frame ``index``."""
        causal = layout.mask_path(self.folder / layout.CAUSAL, index)
        if index in self._refined_frames or not causal.is_file():
            return layout.mask_path(self.folder, index)
        return causal

    def mask(self, index: int) -> NDArray[np.bool_]:
        """The estimated mask ``(H, W)`` of frame ``index``.

        Raises:
            InputError: If there is none, or it is of another size than the frames.
        """
        path = self.mask_path(index)
        mask = read_mask(path)
        if mask is None:
            raise InputError(
                f"The run {self.folder} has no mask of frame {index}; {path.name} is missing or damaged."
            )
        if mask.shape != (size := (self.camera.height, self.camera.width)):
            raise InputError(
                f"The mask {path} is {pixels(mask.shape)} pixels, but the frames of the run are {pixels(size)}; "
                "restore it."
            )
        return mask

    def pinhole_mask(self, index: int) -> NDArray[np.bool_]:
        """The estimated mask ``(H, W)`` as the camera of the poses sees it, without the distortion of a lens.

        Raises:
            InputError: If there is none.
        """
        return self.camera.mask_to_pinhole(self.mask(index))

    def visible_mask(self, index: int) -> NDArray[np.bool_]:
        """What is seen of the object in frame ``index``, ``(H, W)``: its mask without what is in front of it.

        Raises:
            InputError: If there is no mask, or it is of another size than the frames.
        """
        mask, occluder = self.mask(index), read_occluder(self.folder, index)
        return mask if occluder is None else mask & ~occluder

    def visible_pinhole_mask(self, index: int) -> NDArray[np.bool_]:
        """The same as the camera of the poses sees it, see `pinhole_mask`.

        Raises:
            InputError: If there is no mask.
        """
        return self.camera.mask_to_pinhole(self.visible_mask(index))

    def probability(self, index: int) -> NDArray[np.float32] | None:
        """The object probabilities ``(H, W)`` of the final estimate; None if they were not requested."""
        return read_probability(self.folder, index) if self.refined else None

    def initial_mask(self, index: int) -> NDArray[np.bool_] | None:
        """What the mask tracker gave for frame ``index``, ``(H, W)``, or None."""
        return read_mask(layout.initial_mask_path(self.folder, index))

    @property
    def mesh_folder(self) -> Path:
        """Folder of the mesh that belongs to the estimates, if there is one; see `load_mesh` and `load_model`."""
        causal = self.folder / layout.CAUSAL
        of_causal = not self._refined_frames and (causal / layout.OBJ).is_file()
        return causal if of_causal else self.folder

    def mesh(self) -> trimesh.Trimesh:
        """The textured mesh in object coordinates; see `load_mesh`."""
        return load_mesh(self.mesh_folder)


def is_finished(folder: Path) -> bool:
    """Whether a folder holds a run that is finished.

    Raises:
        InputError: If its ``run.json`` cannot be read.
    """
    return (folder / layout.RUN).is_file() and RunReader(folder).state == "finished"


def replacement_has_begun(folder: Path) -> bool:
    """Whether the corrected run is taking the place of a run: its lines do so first, its description last.

    Raises:
        InputError: If the description of the corrected run cannot be read.
    """
    stage = folder / layout.CORRECTING
    return not (stage / layout.FRAMES).is_file() and is_finished(stage)


def _check_whole(folder: Path, description: Mapping[str, Any]) -> None:
    if description.get("scaling"):
        raise InputError(
            f"Only some files of {folder} are in metres, since that was interrupted; resume the run, or give "
            "`tracking3d model` its --object-size, which completes it."
        )
    if replacement_has_begun(folder):
        raise InputError(
            f"Only some files of {folder} are those of its correction, since that was interrupted; repeat the "
            "`tracking3d correct`, which completes it."
        )


def read_records(path: Path, end: int | None = None) -> Iterator[FrameRecord]:
    """All lines of a ``frames.jsonl``, revisions included; a last line that was cut off is left out.

    Args:
        path: The file.
        end: Bytes of it that are read; None for all.

    Raises:
        InputError: If another line is damaged.
    """
    if not path.is_file():
        return
    with _readable(path), path.open("rb") as file:
        read = 0
        for number, line in enumerate(iter(lambda: file.readline(LONGEST_LINE), b""), 1):
            read += len(line)
            if end is not None and read > end:
                return
            try:
                yield FrameRecord.from_line(line, path)
            except ValueError as error:
                # A kill cuts the last line off; what it leaves has a beginning and no end.
                if line.startswith(b"{") and len(line) < LONGEST_LINE and not line.endswith(b"\n"):
                    return
                raise InputError(f"Line {number} of {path} is damaged ({error}); remove it.") from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}); restore it.") from error


def _camera_fault(camera: Camera) -> str:
    """Why there is no such camera, or nothing."""
    for name in ("width", "height"):
        value = getattr(camera, name)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 < value <= LONGEST_SIDE:
            return f"{name} is {value!r:.40}"
    for name in ("fx", "fy", "cx", "cy"):
        value = getattr(camera, name)
        number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _FARTHEST
        if not number or (name in ("fx", "fy") and not value > 0):
            return f"{name} is {value!r:.40}"
    deviation = camera.focal_deviation
    if deviation is not None and not (isinstance(deviation, int | float) and 0 <= deviation < _FARTHEST):
        return f"focal_deviation is {deviation!r:.40}"
    described = isinstance(camera.origin, str) and isinstance(camera.assumed, bool)
    return "" if described else f"origin is {camera.origin!r:.40}, assumed {camera.assumed!r:.40}"


def _read_description(folder: Path) -> dict[str, Any]:
    layout.check_run_folder(folder)
    path = folder / layout.RUN
    try:
        description = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged: it cannot be read ({error}); restore it.") from error
    if not isinstance(description, dict) or description.get("format") != layout.FORMAT:
        raise InputError(f"{folder} is not a run folder: its run.json was not written by tracking3d.")
    version = description.get("format_version")
    if not isinstance(version, int):
        raise InputError(f"{path} is damaged: it holds no format version.")
    if version > layout.FORMAT_VERSION:
        raise FormatError(
            f"The run {folder} has format version {version}, newer than the "
            f"{layout.FORMAT_VERSION} that this tracking3d reads; update tracking3d."
        )
    if version < layout.FORMAT_VERSION:
        raise FormatError(
            f"The run {folder} was written by an earlier version of tracking3d (format {version}); "
            f"run it again with {layout.OVERWRITE}."
        )
    for name, kind in _KINDS.items():
        if name in description and not isinstance(description[name], kind):
            raise InputError(f"{path} is damaged: {name} is {description[name]!r:.40}; restore it.")
    return description


def camera_from_record(record: Mapping[str, Any]) -> Camera:
    """The camera that ``dataclasses.asdict`` made a mapping of.

    Raises:
        TypeError: If a key is missing or unknown.
        ValueError: If the lens is none that can be; says why.
    """
    lens = record.get("lens")
    return Camera(**{**record, "lens": None if lens is None else _read_lens(lens, record)})


def _read_lens(lens: Any, camera: Mapping[str, Any]) -> Lens:
    if not isinstance(lens, Mapping):
        raise ValueError(f"lens is {lens!r:.40}")
    model = lens.get("model")
    if model not in COUNTS:
        raise ValueError(f"the lens has the unknown model {model!r:.40}")
    coefficients = _numbers(lens, "coefficients", COUNTS[model])
    picture, pinhole = (_numbers(lens, name, (4,)) for name in ("picture", "pinhole"))
    if not min(*picture[:2], *pinhole[:2]) > 0:
        raise ValueError("the lens has no focal length")
    if (lens.get("width"), lens.get("height")) != (camera.get("width"), camera.get("height")):
        raise ValueError("the lens belongs to images of another size")
    return Lens(model, coefficients, picture, pinhole, lens["width"], lens["height"])


def _numbers(lens: Mapping[str, Any], name: str, counts: tuple[int, ...]) -> tuple[Any, ...]:
    values = lens.get(name)
    if not isinstance(values, list | tuple) or len(values) not in counts:
        raise ValueError(f"{name} of the lens is {values!r:.40}")
    if not all(isinstance(one, int | float) and math.isfinite(one) for one in values):
        raise ValueError(f"{name} of the lens is {values!r:.40}")
    return tuple(float(one) for one in values)


def open_run_source(run: RunReader, source: str | Path | None = None) -> FrameSource:
    """The video that a run was made on.

    Args:
        run: The run.
        source: Its present path; if left out that in the run, from the present folder or from those above the run's.

    Raises:
        InputError: If it is not there.
    """
    named = source if source is not None else run.description.get("source")
    if not isinstance(named, str | Path) or not str(named) or str(named).isdigit():
        raise InputError(f"The video of the run {run.folder} cannot be read again; give it as --source.")
    places = [Path(named)] if source is not None else places_of(str(named), run.folder)
    there = next((place for place in places if place.exists()), named)
    try:
        return open_source(str(there), run.description.get("selection"))
    except InputError as error:
        raise InputError(
            f"The video of the run {run.folder} cannot be read ({str(error).rstrip('.')}); give its path as --source."
        ) from error


def places_of(source: str, folder: Path) -> list[Path]:
    """Candidate paths of a run's video: its path was relative to the working directory of the run.

    Args:
        source: What ``run.json`` calls it.
        folder: The run folder.
    """
    name = Path(source).expanduser()
    return [name] if name.is_absolute() else [name, *(above / name for above in folder.resolve().parents)]
