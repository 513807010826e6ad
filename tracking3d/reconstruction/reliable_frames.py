"""The frames of a run whose poses are reliable, read from its video once more."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from tracking3d.checkpoint.progress import checksum
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.frames import Frame, pixels
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import report_each
from tracking3d.video.opening import open_source
from tracking3d.video.source import FrameSource


def reliable_frames(run: RunReader, source: str | FrameSource | None) -> Iterator[tuple[Frame, FrameRecord]]:
    """Each frame that is tracked with enough confidence, with its estimate; as the camera of the poses sees it.

    Args:
        run: The run.
        source: Its video, or its path; None for the one that it names.

    Raises:
        InputError: If it goes on, or the video is another one.
    """
    if run.state == "running":
        raise InputError(f"The run {run.folder} is still going; wait for its end.")
    video = source or str(run.description.get("source", ""))
    if isinstance(video, str):
        video = open_source(video, run.description.get("selection"))
    name = video.name
    records = {record.index: record for record in run.frames}
    prompt = run.description.get("prompt") or {}
    for frame in report_each("reading frames", video, video.count):
        record = records.get(frame.index)
        if not isinstance(frame, Frame) or record is None:
            continue
        expected = (run.camera.height, run.camera.width)
        if frame.size != expected:
            raise InputError(
                f"{name} has frames of {pixels(frame.size)} pixels but the run {run.folder} of "
                f"{pixels(expected)}; give its video by --source."
            )
        if frame.index == prompt.get("first_frame") and checksum(frame.image) != prompt.get(
            "first_image_crc"
        ):
            raise InputError(
                f"{name} does not begin as the video of the run {run.folder} did; give that by --source."
            )
        if record.status is Status.TRACKED:
            yield replace(frame, image=run.camera_of(record).undistort(frame.image)), record


def no_reliable_frame_error(run: RunReader) -> InputError:
    """The message if there is no such frame."""
    return InputError(f"No frame of the run {run.folder} is tracked; its mesh stays as it is.")
