"""The plan of a split run: its cuts and the object's masks there, saved so that the run can be resumed."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tracking3d.checkpoint.resuming import prompt_record
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.prompts.prompt import PromptSet
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_atomic, write_mask, writing
from tracking3d.results.records import jsonable
from tracking3d.submaps.cuts import Part, cuts_in, overlap_of, parts_at, windows
from tracking3d.submaps.preview import full_size, preview_video, tracker_for_looking
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
