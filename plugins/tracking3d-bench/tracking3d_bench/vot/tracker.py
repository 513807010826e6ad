"""The tracker for the VOT toolkit's ``python`` protocol."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, Tracking3dError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Image
from tracking3d.video.image_file import read_image
from tracking3d_bench.vot.regions import MaskRows, prompt_of, rectangle_of
from tracking3d_bench.vot.sessions import ObjectSessions, configuration

Status = tuple[Any, dict[str, Any]]
"""A region and its properties."""

_REGIONS = ("mask", "rectangle")
_COLOUR = ("color", "visible", "rgb")


class VotTracker:
    """Follows any number of objects. Each estimate is a mask or rectangle and its ``confidence`` in [0, 1].

    Written against ``vot.tracker.python`` of vot-toolkit 0.9.0. All arguments are strings, since ``arg_`` lines of
    ``trackers.ini`` are.

    Args:
        config: A YAML file of the pipeline.
        preset: Name of a preset; by default that in ``TRACKING3D_PRESET``, or else the default one.
        overrides: ``section.key=value`` items with spaces between.
        region: What is estimated: ``mask`` or ``rectangle``.

    Raises:
        RuntimeError: If one of them cannot be used. Other errors than the built-in ones would leave the toolkit
            waiting, here and in the methods.
    """

    multiobject = True

    def __init__(
        self,
        config: str | None = None,
        preset: str | None = None,
        overrides: str = "",
        region: str = "mask",
    ) -> None:
        with _report_to_toolkit():
            if region not in _REGIONS:
                raise InputError(f"There are no regions '{region}'; choose one of {', '.join(_REGIONS)}.")
            self._config = configuration(config, preset, overrides)
            self._sessions = ObjectSessions(self._config)
        self._region = region

    def init(
        self, frame: Any, new: Sequence[Status] | Status, properties: Mapping[str, Any] | None = None
    ) -> list[Status]:
        """Begin a sequence.

        Args:
            frame: The image's path, or an image ``(H, W, 3)`` RGB; by channel if there are several.
            new: Region and properties of each object; see `tracking3d_bench.vot.regions.prompt_of`.
            properties: Not used.

        Returns:
            Region and properties of each object.

        Raises:
            RuntimeError: If the frame or a region cannot be used.
        """
        self._sessions = ObjectSessions(self._config)
        return self.update(frame, new, properties)

    def update(
        self, frame: Any, new: Sequence[Status] | Status = (), properties: Mapping[str, Any] | None = None
    ) -> list[Status]:
        """Track the next frame, in which objects may be new; see `init`."""
        with _report_to_toolkit():
            objects = [new] if isinstance(new, tuple) and new else new
            prompts = [partial(prompt_of, region) for region, _ in objects]
            return [self._status(estimate) for estimate in self._sessions.step(_image(frame), prompts)]

    def _status(self, estimate: FrameEstimate) -> Status:
        region = MaskRows.of(estimate.mask) if self._region == "mask" else rectangle_of(estimate.mask)
        return region, {"confidence": float(estimate.confidence)}


@contextmanager
def _report_to_toolkit() -> Iterator[None]:
    try:
        yield
    except Tracking3dError as error:
        raise RuntimeError(str(error)) from error


def _image(frame: Any) -> Image:
    if isinstance(frame, Mapping):
        channel = next((name for name in _COLOUR if name in frame), None)
        if channel is None:
            raise InputError(f"A frame has the channels {', '.join(frame)}, none of which is {_COLOUR[0]}.")
        frame = frame[channel]
    return read_image(Path(frame)) if isinstance(frame, str | Path) else _three_channels(np.asarray(frame))


def _three_channels(image: NDArray) -> NDArray:
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image
