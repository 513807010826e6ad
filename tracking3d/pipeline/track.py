"""The pipeline as functions: frames go in, estimates come out.

>>> for estimate in track(frames, box=(x, y, w, h)):  # doctest: +SKIP
...     print(estimate.index, estimate.status, estimate.T_cam_obj)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.camera import choose_camera, set_object_size
from tracking3d.config.explain import format_value
from tracking3d.config.loading import ModelChoice, check_model, set_model
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Box
from tracking3d.pipeline.components import SOLVERS
from tracking3d.pipeline.open_tracking import TrackRequest, request_tracking
from tracking3d.pipeline.point_queries import validate_queries
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.tracking import Tracking, track_frames
from tracking3d.pipeline.validation import set_known_object, validate_config
from tracking3d.reconstruction.rebuild import check_packages
from tracking3d.trackers.prompts.corrections import Correction
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video.in_memory import open_frames, validate_image
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
    object_size: float | None = None,
) -> Tracking:
    """Track an object through frames; estimates come as the frames do, memory is bounded by the keyframes.

    Args:
        frames: What `open_source` opens by a path; ``(N, H, W, 3)`` uint8 RGB; a tensor ``(N, 3, H, W)`` or ``(N, H, W,
            3)`` of uint8 or of floats in [0, 1]; a ``cv2.VideoCapture``; a `FrameSource`; or any iterable of such
            images, images of Pillow, paths of images and `Frame` objects. Frames that could not be read are passed
            over, but not the first.
        box: The object in the first frame, ``(x, y, width, height)`` in pixels.
        mask: The object in the first frame, ``(H, W)`` bool.
        points: The object in the first frame by ``(N, 3)`` points: x, y in pixels, and 1 on it or 0 on the background.
            One of box, mask and points is given, or none if the tracker knows its masks (``precomputed``).
        start_frame: Index of the frame in which the object is given, instead of the first. Estimates then come from
            there to the end, and after them backwards to the beginning. Only if the source can be read again.
        corrections: Prompts in later frames: the mask tracker is re-anchored there, and the mask is trusted.
        config: The pipeline, or a YAML file of one; the default preset if None.
        skip_damaged: If the first frame cannot be decoded, apply the prompt to the first frame that can.
        follow: Surface points to follow: ``(N, 2)`` pixels of the frame in which the object is given, or ``(N, 3)`` of
            frame, x, y. Each estimate says in ``points`` where they are, by the frames until then; the result in
            ``tracks``, by the whole video.
        refine: Whether the `Tracking.result` looks at the whole video once more; None leaves that to the configuration,
            as the command line does.
        model: The final mesh: ``none`` keeps the online texture, ``fast`` takes the
            texture from the video at its resolution, ``fine`` then makes the shape again too from all frames, and keeps
            it if it explains them better; None leaves that to the configuration.
        object: The folder of an earlier run, or a mesh file: the object is that one. It is then found without a box,
            or with one, estimates are in its coordinates and unit, and its shape and colours are held.
        object_size: Metres of the object's longest side; all lengths of the `Tracking.result` are then in metres.
            Estimates on the way are in a unit of their own, since the shape is not known before the end.

    Returns:
        An iterator of one estimate a frame, whose `Tracking.result` is all of it.

    Raises:
        Tracking3dError: If an argument cannot be used; on the way, if a frame cannot, or the first one does not fit
            the box or mask.
    """
    source, config = open_frames(frames), set_known_object(validate_config(config), object)
    config = config_of_result(set_object_size(config, object_size), source, refine, model)
    prompts = PromptSet.of_one(box, mask, points, start_frame)
    request = request_tracking(source, config, prompts, corrections, skip_damaged)
    kept = any(option is not None for option in (refine, model, object_size))
    return Tracking(request, kept, validate_queries(follow))


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

    An object whose plug-in has failed for good, see ``runtime.on_plugin_failure``, is estimated as lost from then on;
    the others continue.

    Args:
        frames: See `track`.
        boxes: The objects in the first frame, each ``(x, y, width, height)`` in pixels.
        masks: More objects, after those of the boxes, each ``(H, W)`` bool.
        points: More objects, after those of the masks, each by points.
        start_frame: The frame in which the objects are given.
        corrections: Prompts in later frames; `Correction.object` is the number of the object.
        config: The pipeline of every object, or a YAML file of one; the default preset if None.
        skip_damaged: See `track`.

    Returns:
        An iterator of one estimate an object, in the order in which they were given, for each frame.

    Raises:
        Tracking3dError: If an argument cannot be used; on the way, if a frame cannot, the first one does not fit a box
            or mask, or the last object has failed.
    """
    prompts = PromptSet(boxes, masks, points, start_frame, as_lists=True)
    request = request_tracking(open_frames(frames), config, prompts, corrections, skip_damaged)
    return _estimates_of(request)


def _estimates_of(request: TrackRequest) -> Iterator[tuple[FrameEstimate, ...]]:
    """What `track_objects` gives; the source is closed when it ends."""
    with closing(track_frames(request)) as tracked:
        for _, _, estimates in tracked:
            yield estimates


def config_of_result(
    config: PipelineConfig, source: FrameSource, refine: bool | None, model: ModelChoice | None
) -> PipelineConfig:
    """The configuration with the caller's options for the result.

    Args:
        config: The pipeline.
        source: The frames.
        refine: Whether everything is solved once more; None as configured.
        model: The final mesh; None as configured.

    Raises:
        InputError: If that is not possible with this solver or these frames, or a package is missing.
    """
    if refine is not None and not isinstance(refine, bool):
        raise InputError(f"refine={format_value(refine)} is neither True nor False.")
    if model is not None:
        check_model(model)
    solver = config.solver
    if refine is not None:
        solver = solver.model_copy(update={"final_refine": refine})
    if refine and not hasattr(SOLVERS[solver.name], "refine"):
        raise InputError(
            f"refine=True: the solver {solver.name} gives causal estimates only; choose solver.name online."
        )
    if refine and not source.repeatable:
        raise InputError(
            f"refine=True: {source.name} comes once only, and all frames are needed a second time; give a list or path."
        )
    config = set_model(config.model_copy(update={"solver": solver}), model)
    if model == "fine":
        if not source.repeatable:
            raise InputError(
                f"model='fine' makes the shape again from all frames, and {source.name} comes once only; give a list "
                "or path, or leave it out."
            )
        check_packages()
    if model == "fast" and not source.repeatable:
        raise InputError(
            f"model='fast' takes the texture from the frames as they are re-estimated, which {source.name} does not "
            "allow; leave it out."
        )
    return config
