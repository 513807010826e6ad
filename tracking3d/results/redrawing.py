"""Overlay and contact sheet of a run that has ended, drawn again from what it has saved."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Frame, Image
from tracking3d.results import layout
from tracking3d.results.contact_sheet import COLUMNS, CROPS, Thumbnails, crop_positions, draw_contact_sheet
from tracking3d.results.files import write_image, writing
from tracking3d.results.mesh_export import load_model
from tracking3d.results.overlay import OverlaySize
from tracking3d.results.pictures import Pictures, kept_estimate
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_writer import DEFAULT_FPS
from tracking3d.video import open_source
from tracking3d.video.image_file import read_image


def redraw_contact_sheet(run: RunReader) -> None:
    """Draw the contact sheet of a run again: with its crops, or those of its overlay, and its model as it is now.

    A run without an overlay, or that was killed, is left without change.

    Raises:
        InputError: If the run is damaged.
        OutputError: If it cannot be written.
    """
    records, size, path = run.frames, OverlaySize.of(run.camera), run.folder / layout.CONTACT_SHEET
    positions, thumbnails = crop_positions(len(records)), Thumbnails()
    try:
        earlier = read_image(path) if path.is_file() else None
    except InputError:  # it is damaged
        earlier = None
    images = overlay_frames(run, positions) if earlier is None else [earlier] * len(positions)
    for position, image in zip(positions, images, strict=False):
        record = records[position]
        estimate = kept_estimate(record, run.mask(record.index), None, run.camera)
        thumbnails.keep(image[: size.picture], size.scale, estimate)
    if thumbnails.kept and "counts" in run.description:
        replaced = {one.index for one in records if one.revision and not one.refined}
        crops = thumbnails.spread(CROPS)
        sheet = draw_contact_sheet(crops, _model_of(run), run.description, replaced)
        if earlier is not None:
            rows = -(-len(crops) // COLUMNS) * len(crops[0].image)
            sheet[:rows] = earlier[:rows]
        write_image(path, sheet)


def redraw_overlay(run: RunReader, frames: Iterable[Frame]) -> None:
    """Draw overlay and contact sheet of a finished run again.

    Args:
        run: The run.
        frames: The frames of its video, in order of time.

    Raises:
        InputError: If the run is damaged.
        OutputError: If one cannot be written.
    """
    path = run.folder / layout.OVERLAY
    partial = layout.partial_path(path)
    records = {record.index: record for record in run.frames}
    pictures = Pictures(partial, run.camera, run.description.get("fps") or DEFAULT_FPS)
    try:
        for frame in frames:
            if (record := records.get(frame.index)) is not None:
                mask, initial = run.mask(frame.index), run.initial_mask(frame.index)
                pictures.add_kept(frame, record, mask, initial)
        pictures.close()
        if pictures.any:
            with writing(path):
                partial.replace(path)
    finally:
        pictures.close()
        partial.unlink(missing_ok=True)
    sheet = pictures.contact_sheet(_model_of(run), run.description)
    if sheet is not None:
        write_image(run.folder / layout.CONTACT_SHEET, sheet)


def overlay_frames(run: RunReader, positions: Sequence[int]) -> Iterator[Image]:
    """The overlays ``(H, W, 3)`` of the estimates at ``positions``, status bar included.

    The video has one frame per estimate, in their order. It may end early, as if the run was killed, or be damaged:
    then so do these.

    Args:
        run: The run.
        positions: Rising positions in ``run.frames``.
    """
    path = run.folder / layout.OVERLAY
    wanted = set(positions)
    if not wanted or not path.is_file():
        return
    last = max(wanted)
    try:
        for number, frame in enumerate(open_source(str(path))):
            if not isinstance(frame, Frame):
                return
            if number in wanted:
                yield frame.image
            if number == last:
                return
    except Tracking3dError:
        return


def _model_of(run: RunReader) -> ObjectModel | None:
    try:
        return load_model(run.mesh_folder)
    except InputError:
        return None
