"""The texture, and the shape, of a run that exists, from its estimates and the video that it was made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.frames import mask_iou_or_none
from tracking3d.reconstruction.run_views import (
    RunViews,
    collect_views,
    no_reliable_frame_error,
    reliable_frames,
)
from tracking3d.reconstruction.seen_regions import close_unseen
from tracking3d.reconstruction.shape import reconstruct_shape
from tracking3d.reconstruction.texturing import bake_texture, replace_shape
from tracking3d.reconstruction.views import keep_best_views, texture_view
from tracking3d.results import layout
from tracking3d.results.mesh_export import export_mesh, load_model
from tracking3d.results.notes import notes_of_run
from tracking3d.results.records import FrameRecord
from tracking3d.results.redrawing import redraw_contact_sheet
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import load_own_model, read_own_records
from tracking3d.runtime.progress import report_progress
from tracking3d.scene.view import ObjectView
from tracking3d.video.source import FrameSource

EXTENDS = "extends"
"""Key in ``run.json`` of the run whose frames made the mesh, too."""
_NEEDED = ("skimage", "fast_simplification")


@dataclass(frozen=True, eq=False)
class ShapedRun:
    """What came of a reconstruction."""

    model: ObjectModel  # the run's mesh as it is now
    views: int  # frames that its texture was taken from
    new: bool  # whether it has a new shape
    sentence: str  # how much better that is, or why the old one stays


def retexture_run(
    folder: Path, source: str | None = None, most: int = 24, largest: int = 2048
) -> tuple[ObjectModel, int]:
    """Write the mesh of the online map of a run again, with a texture at the resolution of its video.

    Args:
        folder: The run folder.
        source: The video; None for the one that the run names.
        most: Frames that the texture is taken from.
        largest: Most texels along a side.

    Returns:
        The model, and how many frames its texture was taken from.

    Raises:
        InputError: If the run goes on, has no mesh or no reliable frame, or the video is another one.
        OutputError: If the mesh cannot be written.
    """
    run = RunReader(folder)
    model = online_model(run)
    views: tuple[ObjectView, ...] = ()
    for frame, record in reliable_frames(run, source):
        mask, camera = run.visible_pinhole_mask(frame.index), run.camera_of(record)
        view = texture_view(
            ObjectView.of_frame(frame.index, frame.image, mask, camera, np.asarray(record.T_cam_obj))
        )
        views = views if view is None else keep_best_views(views, view, most)
    if not views:
        raise no_reliable_frame_error(run)
    model = close_unseen(bake_texture(model, views, largest))
    _replace_mesh(run, model)
    return model, len(views)


def rebuild_shape(
    folder: Path, source: str | FrameSource | None = None, most: int = 24, largest: int = 2048
) -> ShapedRun:
    """Reconstruct the shape of a run's object from all its frames, and write the mesh if that explains them better.

    The mesh of the online map is kept in `layout.ONLINE`.

    Args:
        folder: The run folder.
        source: The video, or its path; None for the one that the run names.
        most: Frames that the texture is taken from.
        largest: Most texels along a side.

    Raises:
        InputError: If a package is missing, the run goes on, has no mesh or no reliable frame, or the video
            is another one.
        OutputError: If the mesh cannot be written.
    """
    check_packages()
    run = RunReader(folder)
    online = online_model(run)
    return reshape_run(run, online, collect_views(run, source, most), largest)


def reshape_run(
    run: RunReader,
    online: ObjectModel,
    views: RunViews,
    largest: int,
    others: Sequence[ObjectModel] = (),
    own_textures: tuple[ObjectView, ...] | None = None,
) -> ShapedRun:
    """Reconstruct the shape of a run's object from views, and write the mesh if that explains them better.

    Args:
        run: The run.
        online: Its object, with the mesh of the online map.
        views: Frames with poses of that object.
        largest: Most texels along a side.
        others: The same object as other videos know it, in its coordinates.
        own_textures: The frames that the texture is taken from if the shape stays; None for all of the views.

    Raises:
        InputError: If there is no reliable frame.
        OutputError: If the mesh cannot be written.
    """
    if not views.textures:
        raise no_reliable_frame_error(run)
    starts = [(one.vertices, one.faces) for one in (online, *others)]
    made = reconstruct_shape(starts, views.shapes, views.left_out)
    if made.vertices is None or made.faces is None:
        textures = views.textures if own_textures is None else own_textures
        model = close_unseen(bake_texture(online, textures, largest))
        _replace_mesh(run, model)
        return ShapedRun(model, len(textures), False, made.sentence)
    report_progress("unwrapping the surface")
    made_model = replace_shape(online, made.vertices, made.faces, views.shapes)
    model = close_unseen(bake_texture(made_model, views.textures, largest), made.planes)
    kept = run.mesh_folder / layout.ONLINE
    if not (kept / layout.FEATURES).is_file():
        kept.mkdir(exist_ok=True)
        export_mesh(kept, online, run.unit)
    _replace_mesh(run, model)
    return ShapedRun(model, len(views.textures), True, made.sentence)


_MOVED, _AGREEMENT, _MOST_CHANGED = 0.05, 0.98, 0.1
"""Degrees by which a pose, and IoU with which a mask, is the same; and the share of frames whose may be others while
the shape that they all make stays (chosen)."""


def keep_shape(earlier: Path, folder: Path) -> bool:
    """Give a corrected run the shape that it had before, unless lens, object frame or much of its frames has changed.

    Args:
        earlier: The run before it was corrected.
        folder: The corrected run, finished, with the mesh of its online map.

    Returns:
        Whether it was done.

    Raises:
        InputError: If one of them is damaged.
        OutputError: If the mesh cannot be written.
    """
    before, run = RunReader(earlier), RunReader(folder)
    sentence = before.description.get("shape")
    same_lens = math.isclose(before.camera.fx, run.camera.fx, rel_tol=1e-6)
    if not sentence or before.description.get(EXTENDS) or not same_lens:
        return False
    records = {one.index: one for one in read_own_records(before) if one.status is Status.TRACKED}
    after = {one.index: one for one in run.frames}
    changed = sum(not _is_same_view(before, run, one, after.get(index)) for index, one in records.items())
    if not records or changed > _MOST_CHANGED * len(records):
        return False
    if (before.mesh_folder / layout.ONLINE / layout.FEATURES).is_file():
        kept = run.mesh_folder / layout.ONLINE
        kept.mkdir(exist_ok=True)
        export_mesh(kept, online_model(run), run.unit)
        _replace_mesh(run, load_own_model(before, before.mesh_folder))
    note_in_run(folder, {"shape": sentence})
    return True


def _is_same_view(before: RunReader, run: RunReader, one: FrameRecord, other: FrameRecord | None) -> bool:
    """Whether a frame shows the object at the pose, and in the mask, that it had before."""
    if other is None or not np.isfinite(other.T_cam_obj).all():
        return False
    moved = np.linalg.inv(one.T_cam_obj) @ other.T_cam_obj
    turned = math.degrees(math.acos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1, 1)))
    far = np.linalg.norm(moved[:3, 3]) / np.linalg.norm(one.T_cam_obj[:3, 3])
    if max(turned, math.degrees(far)) > _MOVED:
        return False
    paths = before.mask_path(one.index), run.mask_path(one.index)
    if paths[0].samefile(paths[1]):
        return True
    return (mask_iou_or_none(before.mask(one.index), run.mask(one.index)) or 0.0) > _AGREEMENT


def restore_online_mesh(folder: Path) -> bool:
    """Make the mesh of the online map that of the run again, with the texture that it had then, which may be coarse.

    Returns:
        Whether a reconstructed shape was replaced; otherwise the mesh is that of the online map, and stays as it is.

    Raises:
        InputError: If the run has no mesh.
        OutputError: If the mesh cannot be written.
    """
    run = RunReader(folder)
    model = online_model(run)
    if not (run.mesh_folder / layout.ONLINE / layout.FEATURES).is_file():
        return False
    _replace_mesh(run, model)
    return True


def has_packages() -> bool:
    """Whether what a shape is made with is installed."""
    return all(find_spec(name) is not None for name in _NEEDED)


def check_packages() -> None:
    """Make sure that what a shape is made with is installed.

    Raises:
        InputError: If something is missing; says what to install.
    """
    if not has_packages():
        raise InputError(
            "A new shape needs scikit-image and fast-simplification, and one of them is missing: install them by pip, "
            "or leave the mesh as it is."
        )


def _replace_mesh(run: RunReader, model: ObjectModel) -> None:
    """Write the mesh of a run, and what shows it or speaks of it: its notes and its contact sheet."""
    report_progress("writing the model")
    export_mesh(run.mesh_folder, model, run.unit)
    if run.description.get(EXTENDS):  # whose mesh this no longer is; who extends the run notes it again
        note_in_run(run.folder, {EXTENDS: None})
    if "notes" in run.description:
        note_in_run(run.folder, {"notes": notes_of_run(run.description, model, run.frames)})
    if (run.folder / layout.CONTACT_SHEET).is_file():
        redraw_contact_sheet(RunReader(run.folder))


def online_model(run: RunReader) -> ObjectModel:
    """The object of a run with the mesh of its online map, whatever the final mesh is.

    Raises:
        InputError: If there is none.
    """
    kept = run.mesh_folder / layout.ONLINE
    return load_model(kept if (kept / layout.FEATURES).is_file() else run.mesh_folder)
