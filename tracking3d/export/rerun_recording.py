"""A recording for the viewer rerun: images, masks, mesh, poses, and the status and confidence of each frame.

Entities: ``camera`` (pinhole, OpenCV's axes), ``camera/image``, ``camera/mask``, ``camera/object`` (pose and mesh),
``status`` and ``confidence``. Timelines: ``frame``, and ``time`` where the run knows it. If there is no pose,
the last one stays and ``status`` says so.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tracking3d.export.exported_run import ExportedRun

if TYPE_CHECKING:
    from rerun import RecordingStream

_QUALITY = 90


def write_rerun(run: ExportedRun, path: Path) -> None:
    """Write the recording; pictures too unless they were not wanted."""
    import rerun

    recording = rerun.RecordingStream("tracking3d", recording_id=run.name)
    recording.save(path)
    model = run.model
    camera = rerun.Pinhole(
        image_from_camera=run.camera.K,
        resolution=[run.camera.width, run.camera.height],
        camera_xyz=rerun.ViewCoordinates.RDF,
    )
    recording.log("camera", camera, static=True)
    mesh = rerun.Mesh3D(
        vertex_positions=model.vertices[model.faces].reshape(-1, 3),
        vertex_texcoords=model.face_uvs.reshape(-1, 2),
        albedo_texture=model.texture,
    )
    recording.log("camera/object", mesh, static=True)
    _log_answers(recording, run)
    if run.options.images:
        for frame in run.pinhole_pictures():
            _set_time(recording, run, frame.index)
            recording.log("camera/image", rerun.Image(frame.image).compress(_QUALITY))
    recording.flush()
    recording.disconnect()


def _log_answers(recording: RecordingStream, run: ExportedRun) -> None:
    import rerun

    posed = {one.index: one for one in run.poses}
    for index, record in run.records.items():
        _set_time(recording, run, index)
        recording.log("camera/mask", rerun.SegmentationImage(run.pinhole_mask(index).astype(np.uint8)))
        recording.log("status", rerun.TextLog(f"{record.status} {record.reason}".strip()))
        if math.isfinite(record.confidence):
            recording.log("confidence", rerun.Scalars(record.confidence))
        if index in posed:
            T = posed[index].T_through(run.camera)
            recording.log("camera/object", rerun.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))


def _set_time(recording: RecordingStream, run: ExportedRun, index: int) -> None:
    recording.set_time("frame", sequence=index)
    if (seconds := run.seconds(index)) is not None:
        recording.set_time("time", duration=seconds)
