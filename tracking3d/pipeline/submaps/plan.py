"""The plan of a split run: its cuts and the object's masks there, saved so that the run can be resumed."""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig, PluginChoice
from tracking3d.engines.protocol import Reporter
from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, Prompt
from tracking3d.pipeline.open_tracking import open_tracking, request_tracking
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.pipeline.record import RecordOptions, record_tracking
from tracking3d.pipeline.submaps.cuts import Part, Sighting, cuts_in, overlap_of, parts_at, windows
from tracking3d.pipeline.submaps.job import LongVideo, SplitResult, frames_of_part
from tracking3d.pipeline.submaps.submap_runs import PartJob
from tracking3d.results import layout
from tracking3d.results.checkpoint.resuming import prompt_record
from tracking3d.results.files import read_mask, write_atomic, write_mask, writing
from tracking3d.results.overwrite import clear_run_folder
from tracking3d.results.records import jsonable
from tracking3d.results.run_reader import is_finished
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source
from tracking3d.video.source import FrameSource

PARTS = layout.PARTS
"""Folder within that of the run in which the parts are tracked."""
_PLAN = "plan.json"


@dataclass(frozen=True, eq=False)
class Plan:
    """The parts of a video."""

    parts: Sequence[Part]  # the parts, at least one
    seconds: float = 0.0  # time of the preview
    preview_frames: int = 0  # number of frames in the preview


def selection_of(whole: range, start: int, stop: int) -> str:
    """``START:STOP:STEP`` of the selected frames at positions from ``start`` to before ``stop``."""
    indices = whole[start:stop]
    return f"{indices.start}:{indices[-1] + 1}:{indices.step}"


def part_folder(folder: Path, part: Part) -> Path:
    """The run folder of a part."""
    return folder / PARTS / f"part_{part.number}"


def prompts_at(folder: Path, part: Part, prompts: PromptSet, precomputed: bool) -> PromptSet:
    """The prompt in a part's first frame."""
    if part.number == 0 or precomputed:
        return prompts
    return PromptSet.of_one(mask=_cut_mask(folder, part))


def make_plan(
    source: FrameSource,
    config: PipelineConfig,
    folder: Path,
    *,
    count: int,
    length: int,
    first: Frame,
    prompt: Prompt | None,
    selection: str | None,
) -> Plan:
    """Preview the video and cut it; the plan is saved in ``folder`` with the prompts of the parts.

    Args:
        source: The video.
        config: The pipeline.
        folder: The run folder.
        count: Selected frames.
        length: Frames of a part.
        first: The first frame.
        prompt: The object in it.
        selection: ``START:STOP:STEP`` of the selected frames.

    Raises:
        Tracking3dError: If the object cannot be tracked, or a file cannot be written.
    """
    began = time.monotonic()
    allowed = windows(count, length)
    sightings = preview_video(source, prompt, tracker_for_looking(config.tracker), allowed)
    cuts = cuts_in(sightings, allowed)
    parts = parts_at([cut.position for cut in cuts], count, overlap_of(length))
    plan = Plan(parts, time.monotonic() - began, len(sightings))
    with writing(folder / PARTS):
        (folder / PARTS).mkdir(parents=True, exist_ok=True)
    for part, cut in zip(parts[1:], cuts, strict=True):
        assert cut.mask is not None
        put_cut_mask(folder, part, full_size(cut.mask, first.size))
    kept = {**_planned_settings(config, selection, count, length, first, prompt), "plan": asdict(plan)}
    write_atomic(folder / PARTS / _PLAN, json.dumps(jsonable(kept)).encode())
    return plan


def read_plan(
    config: PipelineConfig,
    folder: Path,
    *,
    count: int,
    length: int,
    first: Frame,
    prompt: Prompt | None,
    selection: str | None,
) -> Plan | None:
    """The saved plan; None if there is none. See `make_plan`.

    Raises:
        InputError: If it was made for something else, or is damaged.
    """
    path = folder / PARTS / _PLAN
    if not path.is_file():
        return None
    try:
        kept = json.loads(path.read_bytes())
        plan = kept.pop("plan")
        parts = [Part(**part) for part in plan.pop("parts")]
        found = Plan(parts, **plan)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{path} is damaged ({error}); run it again with {layout.OVERWRITE}.") from error
    asked = jsonable(_planned_settings(config, selection, count, length, first, prompt))
    if different := sorted(key for key in asked if kept.get(key) != asked[key]):
        raise InputError(
            f"The parts in {folder} were tracked with another {' and '.join(different)}; use the same, "
            f"or run again with {layout.OVERWRITE}."
        )
    return found


def has_plan(folder: Path) -> bool:
    """Whether there are parts of a run in its folder, and not something else of that name."""
    return (folder / PARTS / _PLAN).is_file()


def remove_parts(folder: Path) -> None:
    """Remove the parts of a run, if there are some."""
    if has_plan(folder):
        shutil.rmtree(folder / PARTS, ignore_errors=True)


def put_cut_mask(folder: Path, part: Part, mask: Any) -> None:
    """Save the object's mask ``(H, W)`` in a part's first frame.

    Raises:
        OutputError: If it cannot be written.
    """
    write_mask(folder / PARTS / f"cut_{part.number}.png", mask)


def _cut_mask(folder: Path, part: Part) -> Any:
    path = folder / PARTS / f"cut_{part.number}.png"
    mask = read_mask(path)
    if mask is None:
        raise InputError(f"{path} is missing or damaged; run it again with {layout.OVERWRITE}.")
    return mask


def _planned_settings(
    config: PipelineConfig,
    selection: str | None,
    count: int,
    length: int,
    first: Frame,
    prompt: Prompt | None,
) -> Mapping[str, Any]:
    return {
        "configuration": config.model_dump(mode="json"),
        "selection of frames": selection,
        "length of parts": length,
        "source or object": prompt_record(first, prompt, count),
    }


_log = logging.getLogger(__name__)
_WIDTH = 320  # pixels of the longer side
_RATE = 12.0  # frames a second that are looked at, at least
_MOST_STRIDE = 4
_BORDER = 2  # pixels
_LOOKING = PluginChoice(name="flow", segmentation_size=128)
"""Cheaper than `csrt` by far, and uncorrected it follows longer; history/pages/many-videos.md has figures."""


def tracker_for_looking(own: PluginChoice) -> PluginChoice:
    """The mask tracker of the preview: precomputed masks cost nothing; else a fast tracker."""
    return own if own.name == "precomputed" else _LOOKING


def stride_of(fps: float | None) -> int:
    """Step of the preview in frames; 2 if the frame rate is unknown."""
    return 2 if fps is None else min(max(int(fps / _RATE), 1), _MOST_STRIDE)


def preview_video(
    source: FrameSource, prompt: Prompt | None, tracker: PluginChoice, allowed: Sequence[range]
) -> list[Sighting]:
    """The object in the frames up to the last one that may be cut at.

    Args:
        source: The frames.
        prompt: The object in the first of them; None if the tracker knows.
        tracker: See `tracker_for_looking`.
        allowed: Allowed positions of cuts; masks are kept only there.

    Raises:
        PluginError: If the tracker cannot start.
    """
    stride, last = stride_of(source.fps), max((window.stop for window in allowed), default=0)
    whole = tracker.name == "precomputed"
    found: list[Sighting] = []
    looking: PromptedTracker | None = None
    for position, frame in enumerate(source):
        if position >= last:
            break
        if not isinstance(frame, Frame) or (looking is not None and position % stride):
            continue
        small = frame if whole else _small(frame)
        try:
            if looking is None:
                looking = PromptedTracker(tracker, _scale_prompt(prompt, frame, small))
                estimate = looking.start(small)
            else:
                estimate = looking.step(small)
        except PluginError as error:
            if looking is None or not found:
                raise
            _log.warning("The preview ends at %s: %s", frame.label, error)
            break
        mask = estimate.found
        inside = any(position in window for window in allowed)
        found.append(_sighting(position, mask, estimate.score, keep=inside))
    return found


def full_size(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask of the preview at the frames' size ``(height, width)``."""
    if mask.shape == size:
        return mask
    wide = cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(wide >= 0.5, dtype=np.bool_)


def _sighting(position: int, mask: NDArray[np.bool_] | None, score: float, keep: bool) -> Sighting:
    if mask is None:
        return Sighting(position, 0, False, 0.0)
    inner = mask[_BORDER:-_BORDER, _BORDER:-_BORDER]
    touches = bool(np.count_nonzero(inner) < np.count_nonzero(mask))
    return Sighting(position, int(np.count_nonzero(mask)), touches, float(score), mask if keep else None)


def _small(frame: Frame) -> Frame:
    height, width = frame.size
    factor = min(_WIDTH / max(height, width), 1.0)
    if factor == 1.0:
        return frame
    size = max(round(factor * width), 1), max(round(factor * height), 1)
    return replace(frame, image=np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)))


def _scale_prompt(prompt: Prompt | None, frame: Frame, small: Frame) -> Prompt | None:
    if prompt is None or frame.size == small.size:
        return prompt
    x, y = small.size[1] / frame.size[1], small.size[0] / frame.size[0]
    box = (prompt.box[0] * x, prompt.box[1] * y, prompt.box[2] * x, prompt.box[3] * y)
    mask = None
    if prompt.mask is not None:
        shrunk = cv2.resize(prompt.mask.astype(np.float32), small.size[::-1], interpolation=cv2.INTER_AREA)
        mask = np.asarray(shrunk >= 0.5, dtype=np.bool_)
    return Prompt(box, mask if mask is not None and mask.any() else None)


BEFORE = "that was found when they were tracked"
"""The reason for parts that an earlier command could not merge."""


@dataclass(frozen=True, eq=False)
class PlannedVideo:
    """A video that is cut."""

    video: LongVideo  # what is tracked
    config: PipelineConfig  # the pipeline with the mask tracker that was chosen
    choice: str | None  # why it is that one; None if the user named it
    count: int  # frames that were asked for
    plan: Plan  # the plan of its parts
    jobs: tuple[PartJob, ...]  # its parts


def plan_video(tell: Reporter, video: LongVideo) -> PlannedVideo | SplitResult:
    """Cut a video, unless it is one part, or done; ``tell`` is given the estimates if it is tracked here.

    Raises:
        InputError: If the video cannot be split, or the folder holds another run.
        Tracking3dError: The frames finished until then are saved.
    """
    folder, resume = video.folder, video.resume
    opened = open_source(video.source, video.selection)
    frames = frames_of_part(opened, video.config, video.length)
    request = request_tracking(opened, video.config, video.prompts)
    options = RecordOptions(video.command, video.selection, video.overwrite, resume)
    count = opened.count
    assert count is not None
    if not windows(count, frames):
        record_tracking(request, folder, options, tell)
        return SplitResult((folder,), 1, f"{opened.name} has {count} frames, which is one part")
    if resume and (layout.has_state(folder) or is_there(folder)):  # merged already
        record_tracking(request, folder, options, tell)
        remove_parts(folder)
        return SplitResult((folder,), 1)
    if not resume:
        clear_run_folder(folder, video.overwrite)
        remove_parts(folder)
    with open_tracking(replace(request, skip_damaged=True), folder if resume else None) as tracking:
        config, choice, first = tracking.config, tracking.tracker_choice, tracking.first
        prompt = tracking.objects[0].prompt
    asked: dict[str, Any] = {
        "count": count, "length": frames, "first": first, "prompt": prompt, "selection": video.selection,
    }  # fmt: skip
    kept = read_plan(config, folder, **asked) if resume else None
    plan = kept or make_plan(opened, config, folder, **asked)
    if len(plan.parts) == 1:
        remove_parts(folder)
        record_tracking(request, folder, options, tell)
        return SplitResult((folder,), 1, "no frame near the planned cut shows the object well")
    jobs = _part_jobs(video, config, count, plan, resume=kept is not None)
    if kept is not None and all(is_finished(job.folder) for job in jobs):
        return SplitResult(tuple(job.folder for job in jobs), len(jobs), BEFORE)
    return PlannedVideo(video, config, choice, count, plan, jobs)


def is_there(folder: Path) -> bool:
    """Whether a folder holds a run that parts have nothing more to add to."""
    return (folder / layout.RUN).is_file() and not has_plan(folder)


def _part_jobs(
    video: LongVideo, config: PipelineConfig, count: int, plan: Plan, *, resume: bool
) -> tuple[PartJob, ...]:
    return tuple(
        PartJob(
            video.source,
            selection_of(video.frames(count), part.start, part.stop),
            config,
            part_folder(video.folder, part),
            prompts_at(video.folder, part, video.prompts, video.precomputed),
            video.command,
            resume,
        )
        for part in plan.parts
    )
