"""The images of a run, read from its source again."""

from __future__ import annotations

from collections.abc import Container, Iterator

from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, SkippedFrame, pixels
from tracking3d.results.checkpoint.progress import checksum
from tracking3d.results.run_reader import RunReader, places_of
from tracking3d.video import open_source

_SOURCE = argument("source=", "--source")


def read_selected_images(run: RunReader, source: str | None, wanted: Container[int]) -> Iterator[Frame]:
    """The pictures of the ``wanted`` frames, in order.

    Args:
        run: The run.
        source: Where the video is; None if the run found it, from the present folder or from those above the run's.
        wanted: Frame indices.

    Raises:
        InputError: If the video is not there, is a camera, or is another one than the run's.
    """
    name = source if source is not None else run.description.get("source")
    if not isinstance(name, str) or name.isdigit():
        raise InputError(f"The video of the run {run.folder} cannot be read again; give it as {_SOURCE}.")
    places = places_of(name, run.folder) if source is None else []
    name = next((str(place) for place in places if place.exists()), name)
    try:
        opened = open_source(name, run.description.get("selection"))
    except InputError as error:
        raise InputError(
            f"The images of the run {run.folder} cannot be read: {str(error).rstrip('.')}; give the present "
            f"path of its video as {_SOURCE}."
        ) from error
    first = (run.description.get("prompt") or {}).get("first_image_crc")
    size = run.camera.height, run.camera.width
    begun = False
    for frame in opened:
        if isinstance(frame, SkippedFrame) or frame.index not in wanted:
            continue
        if frame.size != size:
            raise InputError(
                f"Frame {frame.index} of {name} has {pixels(frame.size)} pixels, but frames of the run "
                f"{run.folder} have {pixels(size)}; give the video of the run as {_SOURCE}."
            )
        if not begun and first is not None and checksum(frame.image) != first:
            raise InputError(
                f"{name} is not the video of the run {run.folder}: the image of frame {frame.index} differs; "
                f"give the right video as {_SOURCE}."
            )
        begun = True
        yield frame
    if not begun:
        raise InputError(
            f"{name} has no frame of the run {run.folder}; give the video of the run as {_SOURCE}."
        )
