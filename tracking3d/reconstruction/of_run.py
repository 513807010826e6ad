"""The texture of a run that exists, from its answers and the video that it was made of."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tracking3d.checkpoint.progress import checksum
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel, Status
from tracking3d.frames import Frame, pixels
from tracking3d.reconstruction.texturing import textured
from tracking3d.reconstruction.views import BELIEVED, TextureView, kept_views, texture_view
from tracking3d.results.mesh_export import export_mesh, load_model
from tracking3d.results.run_reader import RunReader
from tracking3d.video.opening import open_source


def texture_run(
    folder: Path, source: str | None = None, most: int = 24, largest: int = 2048
) -> tuple[ObjectModel, int]:
    """Write the mesh of a run anew, with a texture at the resolution of its video.

    Args:
        folder: The run folder.
        source: The video; None for the one that the run names.
        most: Frames that the texture is taken from.
        largest: Most texels along a side.

    Returns:
        The model, and how many frames its texture was taken from.

    Raises:
        InputError: If the run goes on, has no mesh or no frame that is believed, or the video is another one.
        OutputError: If the mesh cannot be written.
    """
    run = RunReader(folder)
    if run.state == "running":
        raise InputError(f"The run {folder} is still going; wait for its end.")
    model = load_model(run.mesh_folder)
    views = _views(run, source or str(run.description.get("source", "")), most)
    if not views:
        raise InputError(
            f"No frame of the run {folder} is tracked with a confidence of {BELIEVED} or more; its mesh stays as it is."
        )
    model = textured(model, views, largest)
    export_mesh(run.mesh_folder, model)
    return model, len(views)


def _views(run: RunReader, source: str, most: int) -> tuple[TextureView, ...]:
    records = {record.index: record for record in run.frames}
    given = run.description.get("given") or {}
    views: tuple[TextureView, ...] = ()
    for frame in open_source(source, run.description.get("selection")):
        record = records.get(frame.index)
        if not isinstance(frame, Frame) or record is None:
            continue
        expected = (run.camera.height, run.camera.width)
        if frame.size != expected:
            raise InputError(
                f"{source} has frames of {pixels(frame.size)} pixels but the run {run.folder} of "
                f"{pixels(expected)}; give its video by --source."
            )
        if frame.index == given.get("first_frame") and checksum(frame.image) != given.get("first_picture"):
            raise InputError(
                f"{source} does not begin as the video of the run {run.folder} did; give that by --source."
            )
        if record.status is Status.TRACKED and record.confidence >= BELIEVED:
            camera = run.camera_of(record)
            view = texture_view(
                frame.index,
                camera.undistorted(frame.image),
                run.pinhole_mask(frame.index),
                camera,
                np.asarray(record.T_cam_obj),
            )
            views = views if view is None else kept_views(views, view, most)
    return views
