"""The parts of a video as runs: tracked in a first pass, and refined against the merged object.

What is here runs in processes of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tracking3d.config.models import PipelineConfig
from tracking3d.engines.protocol import Reporter
from tracking3d.frames import Frame
from tracking3d.pipeline.frame_reading import SavedMasks, read_timed
from tracking3d.pipeline.open_tracking import open_tracking, request_tracking
from tracking3d.pipeline.record import RecordOptions, record_tracking
from tracking3d.pipeline.refinement_steps import Retracking
from tracking3d.pipeline.session import Session
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.progress import SavedState
from tracking3d.results.files import read_mask, writing
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates, keep_masks, write_refined
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source, parse_selection
from tracking3d.video.source import FrameSource


@dataclass(frozen=True, eq=False)
class PartJob:
    """One part of a video, to be tracked."""

    source: str  # the video, as `open_source` takes it
    selection: str  # frames of the part, START:STOP:STEP
    config: PipelineConfig  # the pipeline
    folder: Path  # the part's run folder
    prompts: PromptSet  # what the object is in its first frame
    command: str | None = None  # for the record
    resume: bool = False  # continue the run that is there
    first_pass_only: bool = True  # stop when every frame has its causal estimate


def track_part(tell: Reporter, job: PartJob) -> None:
    """Track one part; ``tell`` is given each frame's record.

    Raises:
        Tracking3dError: See `record_tracking`.
    """
    source = open_source(job.source, job.selection)
    if job.resume and job.first_pass_only and is_tracked(job.folder, source):
        return
    request = request_tracking(source, job.config, job.prompts, skip_damaged=True)
    options = RecordOptions(
        job.command, job.selection, not job.resume, job.resume, first_pass_only=job.first_pass_only
    )
    record_tracking(request, job.folder, options, tell)


def is_tracked(folder: Path, source: FrameSource) -> bool:
    """Whether a part has all its causal estimates and its checkpoint."""
    if not ((folder / layout.RUN).is_file() and layout.has_state(folder)):
        return False
    run = RunReader(folder, refined=False)
    if run.state == "failed":  # its last state may be some frames behind
        return False
    return len(run.frames) + len(run.description["skipped"]) == source.count


@dataclass(frozen=True, eq=False)
class Revisit:
    """Frames of the merged run, to be refined against the merged object."""

    source: str  # the video
    whole: str | None  # all selected frames of it, START:STOP:STEP, or None
    selection: str  # the frames that are looked at
    config: PipelineConfig  # the pipeline
    folder: Path  # the folder of the merged run
    prompts: PromptSet  # what the object is in the video's first frame
    out: Path  # folder that gets masks/ and frames.jsonl of the refined estimates


def refine_submap(tell: Reporter, job: Revisit) -> int:
    """Refine some frames, in order of time; ``tell`` is given each estimate's record.

    Returns:
        Number of refined estimates.

    Raises:
        Tracking3dError: If a plug-in fails that may not, or something cannot be read or written.
    """
    kept, session = resume_submap(job)
    retracking = resume_retracking(job, kept, session)
    causal = {one.index: one for one in RunReader(job.folder, refined=False).frames}
    own, selection = frames_with_the_one_before(job)
    with writing(job.out):
        (job.out / layout.MASKS).mkdir(parents=True, exist_ok=True)
    count = 0
    with (job.out / layout.FRAMES).open("wb") as lines:
        for frame in read_timed(open_source(job.source, selection)):
            if not isinstance(frame, Frame) or frame.index not in causal:
                continue
            if frame.index not in own:  # its landmarks are followed into the first frame
                retracking.pass_over(frame, retracking.predict(causal[frame.index]))
                continue
            record_ = _refine_estimate(retracking, job, frame, causal[frame.index])
            if record_ is not None:
                with writing(job.out):
                    lines.write(record_.to_json().encode() + b"\n")
                count += 1
            tell(record_ or causal[frame.index])
    return count


def frames_with_the_one_before(job: Revisit) -> tuple[range, str]:
    """The frames that are looked at, and a selection of them and of the frame before, where there is one."""
    own = parse_selection(job.selection)
    before = max(own.start - own.step, parse_selection(job.whole).start)
    return own, f"{before}:{own.stop}:{own.step}"


def resume_submap(job: Revisit) -> tuple[SavedState, Session]:
    """The state of the merged run, and a session that has its object.

    Raises:
        Tracking3dError: If it cannot be read.
    """
    request = request_tracking(open_source(job.source, job.whole), job.config, job.prompts, skip_damaged=True)
    with open_tracking(request) as opened:
        first, session = opened.first, opened.objects[0].session
    kept = Checkpoint(job.folder, session.state_classes, job.config.runtime.device).read()
    failures = {index: frame.failure for index, frame in kept.taken.items() if frame.failure}
    session.load_state_dict(first, kept.session, failures)
    return kept, session


def resume_retracking(job: Revisit, kept: SavedState, session: Session) -> Retracking:
    """What estimates the frames of the merged run again."""
    estimates = RefinedEstimates.of_folder(job.folder, (session.camera.height, session.camera.width))
    initial = {index: (taken.score, taken.reason) for index, taken in kept.taken.items()}
    return Retracking(session, SavedMasks(estimates, initial))


def _refine_estimate(
    retracking: Retracking, job: Revisit, frame: Frame, causal: FrameRecord
) -> FrameRecord | None:
    """The record of a frame's second estimate, its mask written; None lets the first stand."""
    if (record := retracking.keep(frame.index)) is not None:
        retracking.pass_over(frame, record.T_cam_obj)
        keep_masks(job.folder, job.out, frame.index)
        return record
    estimate = retracking.take(frame)
    if estimate is None:
        return None
    mask = read_mask(layout.initial_mask_path(job.folder, frame.index))
    probabilities = (job.folder / layout.PROBABILITIES).is_dir()
    return write_refined(job.out, estimate, frame, causal, mask, probabilities)
