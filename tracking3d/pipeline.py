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

from tracking3d.arguments import check_frames, checked_config, checked_image
from tracking3d.config.camera import choose_camera
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import PluginError
from tracking3d.estimation.estimate import FrameEstimate, unanswered
from tracking3d.frames import Box, Frame, Image, MaskEstimate, SkippedFrame
from tracking3d.prompts import check_prompt, check_prompts, damaged_start, make_prompt, make_prompts
from tracking3d.session import SOLVERS, Session, build_encoder

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

    Returns:
        An iterator of one estimate a frame.

    Raises:
        Tracking3dError: If an argument cannot be used; on the way, if a frame cannot, or the first one does not fit
            the box or mask.
    """
    check_frames(frames)
    config = checked_config(config)
    check_prompt(box, mask, needed=config.tracker.name != "precomputed")
    return _track(frames, box, mask, config, skip_damaged)


def _track(
    frames: Iterable[Image | Frame | SkippedFrame],
    box: Box | None,
    mask: NDArray[np.bool_] | None,
    config: PipelineConfig,
    skip_damaged: bool,
) -> Iterator[FrameEstimate]:
    session: Session | None = None
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

    Returns:
        An iterator of one estimate an object, in the order in which they were given, for each frame.

    Raises:
        Tracking3dError: If an argument cannot be used; on the way, if a frame cannot, the first one does not fit a box
            or mask, or the last object has failed.
    """
    check_frames(frames)
    config = checked_config(config)
    check_prompts(boxes, masks)
    return _track_objects(frames, boxes, masks, config, skip_damaged)


def _track_objects(
    frames: Iterable[Image | Frame | SkippedFrame],
    boxes: Sequence[Box],
    masks: Sequence[NDArray[np.bool_]],
    config: PipelineConfig,
    skip_damaged: bool,
) -> Iterator[tuple[FrameEstimate, ...]]:
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


def _checked_frames(frames: Iterable[Image | Frame | SkippedFrame], skip_damaged: bool) -> Iterator[Frame]:
    """The frames that could be read, counted, their images copied."""
    for position, item in enumerate(frames):
        if isinstance(item, SkippedFrame):
            if position == 0 and not skip_damaged:
                raise damaged_start(item)
        else:
            frame = item if isinstance(item, Frame) else Frame(position, item)
            yield replace(frame, image=checked_image(frame.image, frame.index))
