"""The pipeline as functions: frames go in, answers come out.

>>> for estimate in track(frames, box=(x, y, w, h)):  # doctest: +SKIP
...     print(estimate.index, estimate.status, estimate.T_cam_obj)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.arguments import check_frames, checked_config, checked_image
from tracking3d.config.camera import choose_camera
from tracking3d.config.models import PipelineConfig
from tracking3d.corrections import Correction, check_corrections_fit, checked_corrections, prompts_in
from tracking3d.errors import PluginError
from tracking3d.estimation.estimate import FrameEstimate, unanswered
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt, SkippedFrame
from tracking3d.parts import SOLVERS, build_encoder, check_turns
from tracking3d.prompts import check_prompt, check_prompts, damaged_start, make_prompt, make_prompts
from tracking3d.session import Session
from tracking3d.tracker_choice import choose_tracker
from tracking3d.video.both_ways import both_ways, check_start_frame

__all__ = ["SOLVERS", "Session", "checked_image", "choose_camera", "track", "track_objects"]


def track(
    frames: Iterable[Image | Frame | SkippedFrame],
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | None = None,
    points: Any = None,
    start_frame: int | None = None,
    corrections: Iterable[Correction] = (),
    config: PipelineConfig | Path | str | None = None,
    skip_damaged: bool = False,
) -> Iterator[FrameEstimate]:
    """Track an object through frames; answers come as the frames do, memory is bounded by the keyframes.

    Args:
        frames: ``(H, W, 3)`` uint8 RGB arrays, or `Frame` objects; frames that could not be read are passed over,
            but not the first.
        box: The object in the first frame, ``(x, y, width, height)`` in pixels.
        mask: The object in the first frame, ``(H, W)`` bool.
        points: The object in the first frame by ``(N, 3)`` points: x, y in pixels, and 1 on it or 0 beside it. One of
            box, mask and points is given, or none where the tracker knows its masks (``precomputed``).
        start_frame: Index of the frame in which the object is given, instead of the first. Answers then come from there
            to the end, and after them backwards to the beginning. Only where frames can be gone through again.
        corrections: What the object is in later frames: there the mask tracker is set on it, and the mask is trusted.
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
    check_prompt(box, mask, needed=config.tracker.name != "precomputed", points=points)
    [told] = checked_corrections(corrections)
    if box is None and mask is None and points is None:
        return _track(_in_order(frames, start_frame, config, True), None, told, config, _count(frames))
    prompt = partial(make_prompt, box=box, mask=mask, points=points)
    return _track(_in_order(frames, start_frame, config, skip_damaged), prompt, told, config, _count(frames))


def _track(
    frames: Iterator[Frame],
    prompt: Callable[[Frame], Prompt] | None,
    corrections: Mapping[int, Correction],
    config: PipelineConfig,
    count: int | None,
) -> Iterator[FrameEstimate]:
    session: Session | None = None
    for frame in frames:
        if session is None:
            its_prompt = prompt and prompt(frame)
            session = Session(_with_tracker(config, count, frame, its_prompt), its_prompt)
            check_corrections_fit(corrections.values(), frame, config.tracker.name)
        yield session.step(frame, *prompts_in(frame, corrections))


def track_objects(
    frames: Iterable[Image | Frame | SkippedFrame],
    *,
    boxes: Sequence[Box] = (),
    masks: Sequence[NDArray[np.bool_]] = (),
    points: Sequence[Any] = (),
    start_frame: int | None = None,
    corrections: Iterable[Correction] = (),
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
        points: More objects, after those of the masks, each by points.
        start_frame: The frame in which the objects are given.
        corrections: What an object is in later frames; `Correction.object` says which, in the order of the objects.
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
    check_prompts(boxes, masks, points)
    told = checked_corrections(corrections, len(boxes) + len(masks) + len(points))
    prompts = partial(make_prompts, boxes=boxes, masks=masks, tracker=config.tracker.name, points=points)
    return _track_objects(
        _in_order(frames, start_frame, config, skip_damaged), prompts, told, config, _count(frames)
    )


def _track_objects(
    frames: Iterator[Frame],
    prompts: Callable[[Frame], list[Prompt]],
    corrections: Sequence[Mapping[int, Correction]],
    config: PipelineConfig,
    count: int | None,
) -> Iterator[tuple[FrameEstimate, ...]]:
    sessions: list[Session] = []
    failures: dict[int, PluginError] = {}
    poses: list[NDArray[np.float64]] = []
    for frame in frames:
        if not sessions:
            encoder = build_encoder(config)
            given = prompts(frame)
            config = _with_tracker(config, count, frame, given[0])
            sessions = [Session(config, prompt, encoder=encoder) for prompt in given]
            for theirs in corrections:
                check_corrections_fit(theirs.values(), frame, config.tracker.name)
            poses = [np.eye(4) for _ in sessions]
        answers = []
        for number, session in enumerate(sessions):
            if number not in failures:
                try:
                    answers.append(session.step(frame, *prompts_in(frame, corrections[number])))
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


def _with_tracker(
    config: PipelineConfig, count: int | None, first: Frame, prompt: Prompt | None
) -> PipelineConfig:
    return config if prompt is None else choose_tracker(config, count, False, first, prompt)[0]


def _count(frames: Any) -> int | None:
    """How many frames there are, where that is known."""
    return len(frames) if isinstance(frames, Sized) else getattr(frames, "count", None)


def _in_order(
    frames: Iterable[Image | Frame | SkippedFrame],
    start_frame: int | None,
    config: PipelineConfig,
    skip_damaged: bool,
) -> Iterator[Frame]:
    """The frames in the order in which they are tracked.

    Raises:
        InputError: If they, or the solver, cannot go both ways though that is asked for.
    """
    if start_frame is None:
        return _checked_frames(frames, skip_damaged)
    name = getattr(frames, "name", "the frame iterable")
    repeatable = getattr(frames, "repeatable", not isinstance(frames, Iterator))
    check_start_frame(start_frame, repeatable, name)
    check_turns(config)
    return _checked_frames(both_ways(lambda: _numbered(frames), start_frame, name), skip_damaged)


def _numbered(frames: Iterable[Image | Frame | SkippedFrame]) -> Iterator[Frame | SkippedFrame]:
    for position, item in enumerate(frames):
        yield (
            item if isinstance(item, Frame | SkippedFrame) else Frame(position, checked_image(item, position))
        )


def _checked_frames(frames: Iterable[Image | Frame | SkippedFrame], skip_damaged: bool) -> Iterator[Frame]:
    """The frames that could be read, counted, their images copied."""
    for position, item in enumerate(frames):
        if isinstance(item, SkippedFrame):
            if position == 0 and not skip_damaged:
                raise damaged_start(item)
        else:
            frame = item if isinstance(item, Frame) else Frame(position, item)
            yield replace(frame, image=checked_image(frame.image, frame.index))
