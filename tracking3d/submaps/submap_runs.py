"""The parts of a video as runs: tracked to the end of their first pass, and looked at again against the whole object.

What is here runs in processes of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.checkpoint.progress import SavedState
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import PluginError
from tracking3d.frames import Box, Frame, MaskEstimate
from tracking3d.pipeline.passes import time_frames
from tracking3d.pipeline.record import first_frame, record
from tracking3d.pipeline.session import Session
from tracking3d.prompts.prompt import make_prompt
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_mask, writing
from tracking3d.results.probabilities import write_probability
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.stage_times import measure
from tracking3d.video import open_source
from tracking3d.video.source import FrameSource

Tell = Callable[[Any], None]


@dataclass(frozen=True, eq=False)
class PromptSet:
    """What the object is in a first frame; nothing if the mask tracker knows. See `tracking3d.pipeline.record`."""

    box: Box | None = None
    mask: NDArray[np.bool_] | Path | None = None
    points: Any = None

    @property
    def untold(self) -> bool:
        """Whether nothing is said."""
        return self.box is None and self.mask is None and self.points is None


@dataclass(frozen=True, eq=False)
class PartJob:
    """One part of a video, to be tracked.

    Attributes:
        source: The video, as `open_source` takes it.
        selection: Frames of the part, ``START:STOP:STEP``.
        config: The pipeline.
        folder: The part's run folder.
        given: What the object is in its first frame.
        command: For the record.
        resume: Go on with what is there.
        first_pass_only: Stop when every frame has its causal answer.
    """

    source: str
    selection: str
    config: PipelineConfig
    folder: Path
    given: PromptSet
    command: str | None = None
    resume: bool = False
    first_pass_only: bool = True


def track_part(tell: Tell, job: PartJob) -> None:
    """Track one part; ``tell`` is given each frame's record.

    Raises:
        Tracking3dError: See `record`.
    """
    source = open_source(job.source, job.selection)
    if job.resume and job.first_pass_only and is_tracked(job.folder, source):
        return
    record(
        source,
        job.config,
        job.folder,
        box=job.given.box,
        mask=job.given.mask,
        points=job.given.points,
        command=job.command,
        selection=job.selection,
        overwrite=not job.resume,
        resume=job.resume,
        skip_damaged=True,
        first_pass_only=job.first_pass_only,
        listener=tell,
    )


def is_tracked(folder: Path, source: FrameSource) -> bool:
    """Whether a part has all its causal answers, and the state to go on from."""
    if not ((folder / layout.RUN).is_file() and layout.has_state(folder)):
        return False
    run = RunReader(folder, refined=False)
    return len(run.frames) + len(run.description["skipped"]) == source.count


def begin_session(source: FrameSource, config: PipelineConfig, given: PromptSet) -> tuple[Frame, Session]:
    """The first frame of a video, and a session for its object that has seen nothing yet.

    Raises:
        Tracking3dError: If there is no such frame, the object cannot be in it, or a plug-in is broken.
    """
    with closing(time_frames(source)) as frames:
        _, first = first_frame(frames, source.name, skip_damaged=True)
    prompt = None if given.untold else make_prompt(first, given.box, given.mask, points=given.points)
    return first, Session(config, prompt, source.intrinsics, source.intrinsics_origin)


@dataclass(frozen=True, eq=False)
class Revisit:
    """Frames of the joined run, to be answered against the whole object.

    Attributes:
        source: The video.
        whole: All selected frames of it, ``START:STOP:STEP``, or None.
        selection: The frames that are looked at.
        config: The pipeline.
        folder: The joined run's.
        given: What the object is in the video's first frame.
        out: Folder that gets ``masks/`` and ``frames.jsonl`` of the second answers.
    """

    source: str
    whole: str | None
    selection: str
    config: PipelineConfig
    folder: Path
    given: PromptSet
    out: Path


def refine_submap(tell: Tell, job: Revisit) -> int:
    """Answer for some frames once more, in order of time; ``tell`` is given each answer's record.

    Returns:
        How many have a second answer.

    Raises:
        Tracking3dError: If a plug-in fails that may not, or something cannot be read or written.
    """
    kept, session = resume_submap(job)
    causal = {one.index: one for one in RunReader(job.folder, refined=False).frames}
    with writing(job.out):
        (job.out / layout.MASKS).mkdir(parents=True, exist_ok=True)
    answered = 0
    with (job.out / layout.FRAMES).open("wb") as lines:
        for frame in time_frames(open_source(job.source, job.selection)):
            if not isinstance(frame, Frame) or frame.index not in causal:
                continue
            record_ = _second_answer(session, job, kept, frame, causal[frame.index])
            if record_ is not None:
                with writing(job.out):
                    lines.write(record_.to_json().encode() + b"\n")
                answered += 1
            tell(record_ or causal[frame.index])
    return answered


def resume_submap(job: Revisit) -> tuple[SavedState, Session]:
    """The state of the joined run, and a session that has its object.

    Raises:
        Tracking3dError: If it cannot be read.
    """
    first, session = begin_session(open_source(job.source, job.whole), job.config, job.given)
    kept = Checkpoint(job.folder, session.state_classes, job.config.runtime.device).read()
    failures = {index: frame.failure for index, frame in kept.taken.items() if frame.failure}
    session.resume(first, kept.session, failures)
    return kept, session


def _second_answer(
    session: Session, job: Revisit, kept: SavedState, frame: Frame, causal: FrameRecord
) -> FrameRecord | None:
    """The record of a frame's second answer, its mask written; None lets the first stand."""
    mask = read_mask(layout.initial_mask_path(job.folder, frame.index))
    taken = kept.taken[frame.index]
    initial = MaskEstimate(None if mask is None else mask.astype(np.float32), taken.score, taken.reason)
    try:
        estimate = session.refine_frame(frame, initial, causal.T_cam_obj)
    except PluginError:
        if job.config.runtime.on_plugin_failure == "stop":
            raise
        return None
    with measure("write") as watch:
        estimate = replace(estimate, refined=True, keyframe=estimate.keyframe or causal.keyframe)
        record_ = FrameRecord.of(estimate, frame.name, mask, revision=True)
        write_mask(layout.mask_path(job.out, frame.index), estimate.mask)
        if (job.folder / layout.PROBABILITIES).is_dir():
            write_probability(job.out, frame.index, estimate.probability)
    return record_.and_wrote(watch.times.write)
