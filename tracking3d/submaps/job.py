"""A long video that is to be tracked in parts, and what becomes of it; both go from process to process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracking3d.config.models import PipelineConfig
from tracking3d.config.solvers import OnlineConfig
from tracking3d.errors import InputError
from tracking3d.prompts.prompt import PromptSet
from tracking3d.submaps.cuts import parse_length
from tracking3d.video.selection import parse_selection
from tracking3d.video.source import FrameSource

Tell = Callable[[Any], None]


@dataclass(frozen=True, eq=False)
class LongVideo:
    """What is to be tracked.

    Attributes:
        source: A video file, or a folder or pattern of images.
        config: The pipeline, with the solver ``online`` and its final refinement.
        folder: The run folder.
        prompts: What the object is in the first frame.
        length: Length of a part, in seconds or frames, see `parse_length`.
        workers: Processes at a time, for the record.
        selection: ``START:STOP:STEP`` of the frames.
        command: For the record.
        overwrite: Replace a run that is in the folder.
        resume: Continue the run that is there.
    """

    source: str
    config: PipelineConfig
    folder: Path
    prompts: PromptSet
    length: str
    workers: int = 2
    selection: str | None = None
    command: str | None = None
    overwrite: bool = False
    resume: bool = False

    @property
    def precomputed(self) -> bool:
        """Whether masks of all frames are given."""
        return self.config.tracker.name == "precomputed"

    def frames(self, count: int) -> range:
        """Indices of the ``count`` selected frames."""
        wanted = parse_selection(self.selection)
        return range(wanted.start, wanted.start + count * wanted.step, wanted.step)


@dataclass(frozen=True)
class SplitResult:
    """What became of a video that was to be split.

    Attributes:
        folders: Its run folder, or those of its parts if they could not be merged.
        parts: How many there were.
        reason: Why they could not be merged, or why it was not cut; empty if they were.
    """

    folders: tuple[Path, ...]
    parts: int
    reason: str = ""


def refuse_what_cannot_be_joined(config: PipelineConfig) -> None:
    """Check that the pipeline can merge parts, which the final refinement of one solver does.

    Raises:
        InputError: If the configuration is without it.
    """
    if not isinstance(config.solver, OnlineConfig) or not config.solver.final_refine:
        raise InputError(
            "Parts of a video are merged in the final refinement of the solver online; leave out --split, or the "
            "option that chooses otherwise (solver.name, solver.final_refine, --quality draft)."
        )


def frames_of_part(source: FrameSource, config: PipelineConfig, length: str) -> int:
    """How many frames a part is to have.

    Raises:
        InputError: If the video cannot be split.
    """
    refuse_what_cannot_be_joined(config)
    if not source.repeatable:
        raise InputError(f"{source.name} comes once only and cannot be split; leave out --split.")
    frames = parse_length(length, source.fps)
    if source.count is None:
        raise InputError(f"{source.name} does not know its number of frames; leave out --split.")
    return frames
