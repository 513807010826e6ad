"""The pipeline as functions: frames go in, answers come out.

>>> for estimate in track(frames, box=(x, y, w, h)):  # doctest: +SKIP
...     print(estimate.index, estimate.status, estimate.T_cam_obj)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.camera import choose_camera
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import PluginError
from tracking3d.estimation.estimate import FrameEstimate, lost_estimate
from tracking3d.frames import Box, Frame, MaskEstimate, Prompt, SkippedFrame
from tracking3d.pipeline.components import SOLVERS, build_encoder
from tracking3d.pipeline.point_queries import validate_queries
from tracking3d.pipeline.record import check_order, open_frames_in_order
from tracking3d.pipeline.result_options import ModelChoice, config_of_result
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.tracker_selection import choose_tracker
from tracking3d.pipeline.tracking import Tracking, TrackRequest
from tracking3d.pipeline.validation import check_known, needs_prompt, set_known_object, validate_config
from tracking3d.prompts.corrections import Correction, check_corrections_fit, prompts_in, validate_corrections
from tracking3d.prompts.prompt import (
    check_prompt,
    check_prompts,
    damaged_start_error,
    make_prompt,
    make_prompts,
)
from tracking3d.video.image_input import validate_image
from tracking3d.video.in_memory import open_frames
from tracking3d.video.source import FrameSource

__all__ = ["SOLVERS", "Session", "Tracking", "choose_camera", "track", "track_objects", "validate_image"]


def track(
    frames: Any,
    *,
    box: Box | None = None,
    mask: NDArray[np.bool_] | None = None,
    points: Any = None,
    start_frame: int | None = None,
    corrections: Iterable[Correction] = (),
    config: PipelineConfig | Path | str | None = None,
    skip_damaged: bool = False,
    follow: Any = None,
    refine: bool | None = None,
    model: ModelChoice | None = None,
    object: str | Path | None = None,
) -> Tracking:
    """Track an object through frames; answers come as the frames do, memory is bounded by the keyframes.

    Args:
        frames: What `open_source` opens by a path; ``(N, H, W, 3)`` uint8 RGB; a tensor ``(N, 3, H, W)`` or ``(N, H, W,
            3)`` of uint8 or of floats in [0, 1]; a ``cv2.VideoCapture``; a `FrameSource`; or any iterable of such
            images, pictures of Pillow, paths of images and `Frame` objects. Frames that could not be read are passed
            over, but not the first.
        box: The object in the first frame, ``(x, y, width, height)`` in pixels.
        mask: The object in the first frame, ``(H, W)`` bool.
        points: The object in the first frame by ``(N, 3)`` points: x, y in pixels, and 1 on it or 0 beside it. One of
            box, mask and points is given, or none where the tracker knows its masks (``precomputed``).
        start_frame: Index of the frame in which the object is given, instead of the first. Answers then come from there
            to the end, and after them backwards to the beginning. Only where frames can be gone through again.
        corrections: What the object is in later frames: there the mask tracker is set on it, and the mask is trusted.
        config: The pipeline, or a YAML file of one; the default preset if None.
        skip_damaged: Where the first frame could not be read, take the box or mask for the first one that could.
        follow: Surface points to follow: ``(N, 2)`` pixels of the frame in which the object is given, or ``(N, 3)`` of
            frame, x, y. Each answer says in ``points`` where they are, by the frames until then; the result in
            ``tracks``, by the whole video.
        refine: Whether the `Tracking.result` looks at the whole video once more; None leaves that to the configuration,
            as the command line does.
        model: What is made of the object for the result: ``none`` leaves what was learnt on the way, ``fast`` takes the
            texture from the video at its resolution, ``fine`` then makes the shape anew too from all frames, and keeps
            it if it explains them better; None leaves that to the configuration.
        object: The folder of an earlier run, or a mesh file: the object is that one. It is then found without a box,
            or with one, answers are in its coordinates and unit, and its shape and colours are held.

    Returns:
        An iterator of one estimate a frame, whose `Tracking.result` is all of it.

    Raises:
        Tracking3dError: If an argument cannot be used; on the way, if a frame cannot, or the first one does not fit
            the box or mask.
    """
    source, config = open_frames(frames), set_known_object(validate_config(config), object)
    config = config_of_result(config, source, refine, model)
    check_prompt(box, mask, needed=needs_prompt(config), points=points)
    [told] = validate_corrections(corrections)
    check_order(source, config, start_frame)
    untold = box is None and mask is None and points is None
    task = TrackRequest(
        source=source,
        config=config,
        prompt=None if untold else partial(make_prompt, box=box, mask=mask, points=points),
        corrections=told,
        start_frame=start_frame,
        skip_damaged=skip_damaged or untold,
        queries=validate_queries(follow),
    )
    return Tracking(task, keeps=refine is not None or model is not None)


def track_objects(
    frames: Any,
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
    source, config = open_frames(frames), validate_config(config)
    check_order(source, config, start_frame)
    check_prompts(boxes, masks, points)
    check_known(config, len(boxes) + len(masks) + len(points))
    told = validate_corrections(corrections, len(boxes) + len(masks) + len(points))
    prompts = partial(make_prompts, boxes=boxes, masks=masks, tracker=config.tracker.name, points=points)
    return _track_objects(source, prompts, told, config, start_frame, skip_damaged)


def _track_objects(
    source: FrameSource,
    prompts: Callable[[Frame], list[Prompt]],
    corrections: Sequence[Mapping[int, Correction]],
    config: PipelineConfig,
    start_frame: int | None,
    skip_damaged: bool,
) -> Iterator[tuple[FrameEstimate, ...]]:
    with open_frames_in_order(source, config, start_frame) as frames:
        yield from _estimate_objects(source, frames, prompts, corrections, config, skip_damaged)


def _estimate_objects(
    source: FrameSource,
    frames: Iterator[Frame | SkippedFrame],
    prompts: Callable[[Frame], list[Prompt]],
    corrections: Sequence[Mapping[int, Correction]],
    config: PipelineConfig,
    skip_damaged: bool,
) -> Iterator[tuple[FrameEstimate, ...]]:
    sessions: list[Session] = []
    failures: dict[int, PluginError] = {}
    poses: list[NDArray[np.float64]] = []
    for frame in frames:
        if isinstance(frame, SkippedFrame):
            if not sessions and not skip_damaged:
                raise damaged_start_error(frame)
            continue
        if not sessions:
            encoder = build_encoder(config)
            given = prompts(frame)
            config, _ = choose_tracker(config, source.count, not source.repeatable, frame, given[0])
            lens = source.intrinsics, source.intrinsics_origin
            sessions = [Session(config, prompt, *lens, encoder) for prompt in given]
            for theirs in corrections:
                check_corrections_fit(theirs.values(), frame, config.tracker.name)
            poses = [np.eye(4) for _ in sessions]
        frame = replace(frame, decoding=frame.decoding / len(sessions))
        estimates = []
        for number, session in enumerate(sessions):
            if number not in failures:
                try:
                    estimates.append(session.step(frame, *prompts_in(frame, corrections[number])))
                    poses[number] = estimates[-1].T_cam_obj
                    continue
                except PluginError as error:
                    failures[number] = error
                    if len(failures) == len(sessions):
                        raise
            why = str(failures[number])
            estimate = lost_estimate(frame, MaskEstimate(None), poses[number])
            estimates.append(replace(estimate, reason=why, failure=why))
        yield tuple(estimates)
