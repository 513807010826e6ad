"""The unit of a run: arbitrary, or metres if the length of the object's longest side is given.

A run is estimated in a unit of its own. Once it is finished, all lengths in its folder are scaled together. In
``frames.jsonl`` scaled lines follow the lines in the run's own unit, which stay: checkpoints for corrections refer to
them by their place.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.camera import check_object_size
from tracking3d.config.models import ObjectConfig
from tracking3d.errors import InputError, argument
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.results import layout
from tracking3d.results.files import write_together
from tracking3d.results.layout import METRE
from tracking3d.results.mesh_export import load_model, mesh_files
from tracking3d.results.point_tracking import read_landmarks, write_landmarks
from tracking3d.results.records import FrameRecord, latest
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.runtime.interruption import interrupts_deferred

_HARDLY_SEEN = 0.1
"""Minimum share of seen faces for which the object's length can be computed from them."""
_SIZE = argument("object_size=", "--object-size")


@dataclass(frozen=True)
class RunScale:
    """What ``run.json`` says of the unit of a run in metres."""

    object_size: float  # metres of the object's longest side
    scale: float  # metres per unit that the run was estimated in, of the final estimates and mesh
    causal_scale: float  # the same of the causal ones, whose mesh is another one
    own_lines: int  # bytes of frames.jsonl in the run's own unit


def metres_per_unit(model: ObjectModel, object_size: float) -> float:
    """The scale that gives the object's longest visible side a length.

    Args:
        model: The mesh.
        object_size: Metres of that side.

    Raises:
        InputError: The mesh has no extent, or the length is none.
    """
    check_object_size(object_size)
    return object_size / visible_side(model)


def scale_pose(T_cam_obj: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """A pose ``(4, 4)`` in another unit."""
    scaled = T_cam_obj.copy()
    scaled[:3, 3] *= scale
    return scaled


def scale_model(model: ObjectModel, scale: float) -> ObjectModel:
    """A mesh in another unit."""
    return model if scale == 1 else replace(model, vertices=model.vertices * scale)


def apply_object_size(folder: Path, config: ObjectConfig) -> None:
    """Put a finished run into metres if its configuration asks for it, and if that was not done before.

    A run of a known object is in metres if the run that the object is from is.

    Args:
        folder: The run folder.
        config: Settings of the object.

    Raises:
        InputError: The run has no mesh to measure.
        OutputError: A file cannot be written.
    """
    complete_scaling(folder)
    run = RunReader(folder)
    if run.state != "finished" or run.unit == METRE:
        return
    if config.size is not None:
        scale_run(folder, config.size)
    elif (
        config.model is not None
        and Path(config.model).is_dir()
        and RunReader(Path(config.model)).unit == METRE
    ):
        size = _scales(RunReader(Path(config.model))).object_size
        _scale_by(folder, replace(_scales(run), object_size=size), {run.mesh_folder: 1.0})


def complete_scaling(folder: Path) -> None:
    """Complete the scaling of a run if that was interrupted.

    Raises:
        InputError: A mesh is damaged.
        OutputError: A file cannot be written.
    """
    run = folder / layout.RUN
    if run.is_file() and (scaling := RunReader(folder, whole=False).description.get("scaling")):
        _scale_files(folder, scaling)


def scale_run(folder: Path, object_size: float) -> None:
    """Put all lengths of a finished run into metres: poses, meshes and landmarks.

    If that is interrupted, call it again.

    Args:
        folder: The run folder.
        object_size: Metres of the object's longest side: of that of the smallest box around what the video has shown.

    Raises:
        InputError: The run is not finished, or has no mesh to measure.
        OutputError: A file cannot be written.
    """
    complete_scaling(folder)
    run, causal = RunReader(folder), RunReader(folder, refined=False)
    if run.state != "finished":
        raise InputError(f"{run.not_finished} Its unit cannot be changed before it is finished; resume it.")
    before = _scales(run)
    factor = metres_per_unit(load_model(run.mesh_folder), object_size)
    causal_factor = metres_per_unit(load_model(causal.mesh_folder), object_size)
    now = RunScale(object_size, before.scale * factor, before.causal_scale * causal_factor, before.own_lines)
    factors = {
        run.mesh_folder / layout.ONLINE: factor,
        causal.mesh_folder: causal_factor,
        run.mesh_folder: factor,
    }
    _scale_by(folder, now, factors)


def unit_scale(run: RunReader) -> float:
    """Metres in the unit that a run was estimated in, if it was put into metres; else 1."""
    return _scales(run).scale


def read_own_records(run: RunReader) -> list[FrameRecord]:
    """The frames of a run in the unit that it was estimated in."""
    if run.unit != METRE:
        return run.frames
    return latest(read_records(run.folder / layout.FRAMES, _scales(run).own_lines), refined=run.refined)


def load_own_model(run: RunReader, mesh_folder: Path) -> ObjectModel:
    """The final mesh of a run, or its online one, in the unit that the run was estimated in.

    Raises:
        InputError: There is no such mesh, or it is damaged.
    """
    return scale_model(load_model(mesh_folder), 1 / _scales(run).scale)


def _scale_by(folder: Path, now: RunScale, factors: Mapping[Path, float]) -> None:
    """Scale all files by what is noted before the first is replaced, so that an interruption can be made good."""
    extents = {
        place.relative_to(folder).as_posix(): by * _extent(load_model(place))
        for place, by in factors.items()
        if (place / layout.FEATURES).is_file()
    }
    _scale_files(folder, {"to": asdict(now), "extents": extents})


def _scale_files(folder: Path, scaling: Mapping[str, Any]) -> None:
    """Write every file in the new unit; what was replaced before an interruption stays as it is."""
    now = RunScale(**scaling["to"])
    runs = [RunReader(folder, refined, whole=False) for refined in (True, False)]
    landmarks = [
        (run, *found, _extent(load_model(run.mesh_folder)))
        for run in runs
        if (found := read_landmarks(run)) is not None
    ]
    file = folder / layout.FRAMES
    own = list(read_records(file, now.own_lines))
    lines = b"".join(record.to_json().encode() + b"\n" for record in _scaled(own, now))
    files = {file: file.read_bytes()[: now.own_lines] + lines}
    for place, extent in scaling["extents"].items():
        model = load_model(folder / place)
        files.update(mesh_files(folder / place, scale_model(model, extent / _extent(model)), METRE))
    with interrupts_deferred():
        write_together(files, partial(note_in_run, folder, {"scaling": scaling}))
        note_in_run(folder, {"unit": {"name": METRE, **asdict(now)}, "scaling": {}})
    for before, vertices, T_cam_obj, extent in landmarks:
        run = RunReader(folder, before.refined)
        by = _extent(load_model(run.mesh_folder)) / extent
        write_landmarks(run, vertices * by, np.stack([scale_pose(T, by) for T in T_cam_obj]))


def _scaled(own: list[FrameRecord], now: RunScale) -> Iterator[FrameRecord]:
    """The estimates that count, in metres: the causal ones, then those of the final refinement."""
    for record in latest(own, refined=False):
        yield replace(record, T_cam_obj=scale_pose(record.T_cam_obj, now.causal_scale))
    for record in latest(own):
        if record.refined:
            yield replace(record, T_cam_obj=scale_pose(record.T_cam_obj, now.scale))


def _scales(run: RunReader) -> RunScale:
    unit = dict(run.description.get("unit") or {})
    if unit.pop("name", None) != METRE:
        return RunScale(0.0, 1.0, 1.0, (run.folder / layout.FRAMES).stat().st_size)
    try:
        return RunScale(**unit)
    except TypeError as error:
        raise InputError(
            f"{run.folder / layout.RUN} is damaged: unit is {unit!r:.40}; restore it."
        ) from error


def _extent(model: ObjectModel) -> float:
    return float(np.ptp(model.vertices, axis=0).max())


def visible_side(model: ObjectModel) -> float:
    """The longest side of what the video has shown of an object; what it has not is a guess, and often too deep.

    For an object that was hardly seen it is that of the whole mesh.

    Raises:
        InputError: If that has no extent.
    """
    height, width = model.texture_weight.shape
    columns = (model.face_uvs[..., 0] * width).astype(int) % width
    rows = (model.face_uvs[..., 1] * height).astype(int).clip(0, height - 1)
    seen = (model.texture_weight[rows, columns] > 0).all(axis=1)
    hardly = seen.mean() < _HARDLY_SEEN
    return longest_side(model.vertices if hardly else model.vertices[np.unique(model.faces[seen])])


def longest_side(vertices: NDArray[np.float64]) -> float:
    """The longest side of the smallest box, turned as it likes, around ``(V, 3)``: what a ruler would give.

    Raises:
        InputError: If the vertices have no extent.
    """
    import trimesh  # slow to import

    try:
        longest = float(max(trimesh.bounds.oriented_bounds(vertices)[1]))
    except Exception:  # a flat or otherwise degenerate hull
        longest = float(np.ptp(vertices, axis=0).max())
    if not 0 < longest < np.inf:
        raise InputError(f"The mesh of the run has no size; leave out {_SIZE}.")
    return longest
