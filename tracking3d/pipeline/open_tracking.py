"""How every tracking begins: the first frame, the mask tracker, the prompts, and a session for each object."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from tracking3d.config.models import AUTO, PipelineConfig, PluginChoice
from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt, SkippedFrame
from tracking3d.pipeline.components import build_encoder, check_backward_tracking
from tracking3d.pipeline.frame_reading import read_from
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.tracker_selection import choose_tracker
from tracking3d.pipeline.validation import (
    check_single_known_object,
    check_source,
    needs_prompt,
    validate_config,
)
from tracking3d.results.layout import RUN
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.corrections import Correction, check_corrections_fit, validate_corrections
from tracking3d.trackers.prompts.prompt import PromptSet, damaged_start_error
from tracking3d.video.both_ways import check_start_frame
from tracking3d.video.source import FrameSource, is_live, known_indices

_log = logging.getLogger(__name__)


class NoFrameError(InputError):
    """A source has no frame that can be decoded."""


@dataclass(frozen=True, eq=False)
class TrackRequest:
    """What is to be tracked, checked as far as possible before the first frame is read; see `request_tracking`."""

    source: FrameSource  # the frames
    config: PipelineConfig  # the pipeline; its mask tracker may be auto
    prompts: PromptSet  # the objects in the prompt frame
    corrections: Sequence[Mapping[int, Correction]]  # for each object, corrections by frame index
    skip_damaged: bool = False  # whether frames that cannot be decoded are skipped until the first that can


def request_tracking(
    source: FrameSource,
    config: PipelineConfig | Path | str | None,
    prompts: PromptSet,
    corrections: Iterable[Correction] = (),
    skip_damaged: bool = False,
) -> TrackRequest:
    """Check what is to be tracked.

    Args:
        source: The frames.
        config: The pipeline, or a YAML file of one; the default preset if None.
        prompts: The objects in the prompt frame.
        corrections: What objects are in later frames; `Correction.object` says which object.
        skip_damaged: If the first frame cannot be decoded, apply the prompts to the first frame that can.

    Raises:
        InputError: If an argument cannot be used.
    """
    check_source(source)
    config = validate_config(config)
    prompts.check(needed=needs_prompt(config))
    check_single_known_object(config, len(prompts))
    by_object = validate_corrections(corrections, max(len(prompts), 1))
    if prompts.start_frame is not None:
        check_start_frame(prompts.start_frame, source.repeatable, source.name)
        check_backward_tracking(config)
    return TrackRequest(source, config, prompts, by_object, skip_damaged or not len(prompts))


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """One object of a tracking."""

    session: Session  # estimates the object in each frame
    # the object in the prompt frame; None if the mask tracker or an earlier run knows it
    prompt: Prompt | None
    corrections: Mapping[int, Correction]  # what the object is in later frames, by their index


@dataclass(frozen=True, eq=False)
class OpenTracking:
    """A tracking of which the first frame is read and no frame is estimated yet."""

    source: FrameSource  # the frames' source
    config: PipelineConfig  # the pipeline; its mask tracker is never auto
    tracker_choice: str | None  # why the mask tracker stands in for auto; None if the user named it
    start_frame: int | None  # index of the prompt frame if frames come both ways from it; else None
    first: Frame  # the prompt frame
    # all frames in the order in which they are tracked; those skipped before first come first
    frames: Iterator[Frame | SkippedFrame]
    objects: tuple[TrackedObject, ...]  # the objects, in the order of their prompts


@contextmanager
def open_tracking(request: TrackRequest, earlier: Path | None = None) -> Iterator[OpenTracking]:
    """Open a tracking: read the first frame, choose the mask tracker, and make prompts and sessions.

    The source is closed at the end.

    Args:
        request: What is to be tracked.
        earlier: The folder of a run that is resumed: its mask tracker stands in for ``auto`` again.

    Raises:
        NoFrameError: If no frame can be decoded.
        InputError: If a prompt or a correction does not fit the first frame.
        PluginError: If a plug-in is unknown or broken.
    """
    source, prompts = request.source, request.prompts
    frames = read_from(source, prompts.start_frame)
    try:
        skipped, first = _read_first(frames, source.name, request.skip_damaged)
        made = prompts.make(first, request.config.tracker.name)
        config, choice = _select_tracker(request, first, earlier)
        encoder = build_encoder(config) if len(made) > 1 else None
        lens, live = (source.intrinsics, source.intrinsics_origin), is_live(source)
        objects = tuple(
            TrackedObject(Session(config, prompt, *lens, encoder, live=live), prompt, corrections)
            for prompt, corrections in zip(made, request.corrections, strict=True)
        )
        indices = known_indices(source)
        for one in objects:
            check_corrections_fit(one.corrections.values(), first, config.tracker.name, indices)
        in_turn = chain(skipped, [first], frames)
        yield OpenTracking(source, config, choice, prompts.start_frame, first, in_turn, objects)
    finally:
        frames.close()


def _read_first(
    frames: Iterator[Frame | SkippedFrame], name: str, skip_damaged: bool
) -> tuple[list[SkippedFrame], Frame]:
    """The first frame that can be decoded, and those before it that cannot."""
    skipped: list[SkippedFrame] = []
    for frame in frames:
        if isinstance(frame, Frame):
            return skipped, frame
        if not skip_damaged:
            raise damaged_start_error(frame)
        skipped.append(frame)
    raise NoFrameError(f"{name} has no frame that can be decoded.")


def _select_tracker(
    request: TrackRequest, first: Frame, earlier: Path | None
) -> tuple[PipelineConfig, str | None]:
    """The configuration with a tracker in place of ``auto``, and why it is that one; None if the user named it."""
    config, source = request.config, request.source
    if config.tracker.name == AUTO and earlier is not None and (earlier / RUN).is_file():
        before = RunReader(earlier, whole=False)
        if why := before.description.get("tracker_choice"):
            tracker = PluginChoice.model_validate(before.config["tracker"])
            return config.model_copy(update={"tracker": tracker}), str(why)
    config, chosen = choose_tracker(config, source.count, not source.repeatable, first.size)
    if chosen is not None:
        _log.info("Mask tracker: %s.", chosen)
    return config, chosen
