"""Several objects followed through one video, each in a session of its own."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

from tracking3d.config.loading import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame, Image, Prompt
from tracking3d.pipeline.track import Session, validate_image

PRESET_VARIABLE = "TRACKING3D_PRESET"
"""Environment variable with the name of the preset if none is given."""


class ObjectSessions:
    """One session an object; objects may come in later frames.

    Args:
        config: The pipeline of all of them.
    """

    def __init__(self, config: PipelineConfig) -> None:
        self._config = config
        self._sessions: list[Session] = []
        self._frames = 0

    def step(self, image: Image, new: Sequence[Callable[[Frame], Prompt]] = ()) -> list[FrameEstimate]:
        """Follow the objects into the next frame, and begin with new ones in it.

        Args:
            image: ``(H, W, 3)`` uint8 RGB.
            new: Say what each new object is, given the frame.

        Returns:
            An estimate for each object, in the order in which they came.

        Raises:
            Tracking3dError: If the image or a prompt cannot be used.
        """
        frame = Frame(self._frames, validate_image(image, self._frames))
        self._frames += 1
        self._sessions += [Session(self._config, prompt(frame)) for prompt in new]
        return [session.step(frame) for session in self._sessions]


def configuration(
    config: str | None = None, preset: str | None = None, overrides: str = ""
) -> PipelineConfig:
    """The pipeline that a tracker's arguments ask for.

    Args:
        config: A YAML file.
        preset: Name of a preset; None takes the environment variable `PRESET_VARIABLE`, if it is set.
        overrides: ``section.key=value`` items with spaces between.

    Raises:
        InputError: If there is no such file, preset, key or value.
    """
    return load_config(
        Path(config) if config else None, preset or os.environ.get(PRESET_VARIABLE) or None, overrides.split()
    )
