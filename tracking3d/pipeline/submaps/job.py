"""A long video that is to be tracked in parts, and what becomes of it; both go from process to process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tracking3d.config.models import OnlineConfig, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.pipeline.submaps.cuts import parse_length
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video.source import FrameSource, parse_selection


@dataclass(frozen=True, eq=False)
class LongVideo:
    """What is to be tracked."""

    source: str  # a video file, or a folder or pattern of images
    config: PipelineConfig  # the pipeline, with the solver online and its final refinement
    folder: Path  # the run folder
    prompts: PromptSet  # what the object is in the first frame
    length: str  # length of a part, in seconds or frames, see `parse_length`
    workers: int = 2  # processes at a time, for the record
    selection: str | None = None  # START:STOP:STEP of the frames
    command: str | None = None  # for the record
    overwrite: bool = False  # replace a run that is in the folder
    resume: bool = False  # continue the run that is there

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
    """What became of a video that was to be split."""

    folders: tuple[Path, ...]  # its run folder, or those of its parts if they could not be merged
    parts: int  # how many there were
    reason: str = ""  # why they could not be merged, or why it was not cut; empty if they were


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
