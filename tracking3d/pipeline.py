"""The pipeline as functions: frames go in, answers come out.

>>> for estimate in track(frames, box=(x, y, w, h)):  # doctest: +SKIP
...     print(estimate.index, estimate.status, estimate.T_cam_obj)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.camera import choose_camera
from tracking3d.config.loading import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, PluginError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Box, Frame, Image, MaskEstimate, SkippedFrame
from tracking3d.prompts import damaged_start, make_prompt, make_prompts
from tracking3d.session import SOLVERS, Session, build_encoder, unanswered

__all__ = ["SOLVERS", "Session", "checked_image", "choose_camera", "track", "track_objects"]


def track(
    frames: Iterable[Image | Frame | SkippedFrame],
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | None = None,
    config: PipelineConfig | Path | str | None = None,
    skip_damaged: bool = False,
) -> Iterator[FrameEstimate]:
    """Track an object through frames; answers come as the frames do, memory is bounded by the keyframes.

    Args:
        frames: ``(H, W, 3)`` uint8 RGB arrays, or `Frame` objects; frames that could not be read are passed over,
            but not the first.
        box: The object in the first frame, ``(x, y, width, height)`` in pixels.
        mask: The object in the first frame, ``(H, W)`` bool. Either a box or a mask is given, or neither where
            the tracker knows its masks (``precomputed``).
        config: The pipeline, or a YAML file of one; the default preset if None.
        skip_damaged: Where the first frame could not be read, take the box or mask for the first one that could.

    Yields:
        One estimate a frame.

    Raises:
        Tracking3dError: If the input or the configuration cannot be used.
    """
    session: Session | None = None
    config = _loaded(config)
    for frame in _checked_frames(frames, skip_damaged or (box is None and mask is None)):
        if session is None:
            prompt = None if box is None and mask is None else make_prompt(frame, box, mask)
            session = Session(config, prompt)
        yield session.step(frame)


def track_objects(
    frames: Iterable[Image | Frame | SkippedFrame],
    *,
    boxes: Sequence[Box] = (),
    masks: Sequence[NDArray[np.bool_]] = (),
    config: PipelineConfig | Path | str | None = None,
    skip_damaged: bool = False,
) -> Iterator[tuple[FrameEstimate, ...]]:
    """Track several objects through frames that are gone through once; see `track`.

    An object whose plug-in has failed for good, see ``runtime.on_plugin_failure``, is answered as lost from then on;
    the others go on.

    Args:
        frames: See `track`.
        boxes: The objects in the first frame, each ``(x, y, width, height)`` in pixels.
        masks: More objects, after those of the boxes, each ``(H, W)`` bool.
        config: The pipeline of every object, or a YAML file of one; the default preset if None.
        skip_damaged: See `track`.

    Yields:
        One estimate an object, in the order in which they were given.

    Raises:
        Tracking3dError: If the input or the configuration cannot be used, or the last object has failed.
    """
    config = _loaded(config)
    sessions: list[Session] = []
    failures: dict[int, PluginError] = {}
    poses: list[NDArray[np.float64]] = []
    for frame in _checked_frames(frames, skip_damaged):
        if not sessions:
            prompts = make_prompts(frame, boxes, masks, config.tracker.name)
            encoder = build_encoder(config)
            sessions = [Session(config, prompt, encoder=encoder) for prompt in prompts]
            poses = [np.eye(4) for _ in sessions]
        answers = []
        for number, session in enumerate(sessions):
            if number not in failures:
                try:
                    answers.append(session.step(frame))
                    poses[number] = answers[-1].T_cam_obj
                    continue
                except PluginError as error:
                    failures[number] = error
                    if len(failures) == len(sessions):
                        raise
            why = str(failures[number])
            answer = unanswered(frame, MaskEstimate(None), poses[number])
            answers.append(replace(answer, reason=why, failure=why))
        yield tuple(answers)


def _loaded(config: PipelineConfig | Path | str | None) -> PipelineConfig:
    if config is not None and not isinstance(config, PipelineConfig | str | Path):
        raise InputError(
            f"config is a {type(config).__name__}; give a PipelineConfig (see load_config) or a YAML file."
        )
    if isinstance(config, PipelineConfig):
        return config
    return load_config(Path(config) if config is not None else None)


def _checked_frames(frames: Iterable[Image | Frame | SkippedFrame], skip_damaged: bool) -> Iterator[Frame]:
    """The frames that could be read, counted, their images copied."""
    for position, item in enumerate(frames):
        if isinstance(item, SkippedFrame):
            if position == 0 and not skip_damaged:
                raise damaged_start(item)
        else:
            frame = item if isinstance(item, Frame) else Frame(position, item)
            yield replace(frame, image=checked_image(frame.image, frame.index))


def checked_image(image: Image, position: int) -> Image:
    """A copy of an image that is ``(H, W, 3)`` uint8; callers like to decode every frame into one buffer.

    Raises:
        InputError: If it is not.
    """
    image = np.array(image, order="C")
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise InputError(
            f"Frame {position} has shape {image.shape} and type {image.dtype}; give (H, W, 3) arrays of uint8."
        )
    return image
