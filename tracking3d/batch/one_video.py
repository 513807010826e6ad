"""A worker's task for one video: track it in a work folder, and move the complete run folder into place."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from tracking3d.batch.datasets import dataset_reader
from tracking3d.batch.storage import absolute, copy_to_local, join_path, local, remove, send, write
from tracking3d.batch.summary import MARKER, write_marker
from tracking3d.batch.video_job import SharedNetwork, VideoJob, keep_networks
from tracking3d.config.models import PipelineConfig
from tracking3d.engines.protocol import Reporter
from tracking3d.errors import InputError, OutputError
from tracking3d.frames import SkippedFrame
from tracking3d.results import layout
from tracking3d.results.files import write_atomic, writing
from tracking3d.results.records import FrameRecord
from tracking3d.runtime.progress import ProgressListener, StageProgress, listen_to_progress
from tracking3d.trackers.prompts.boxes import parse_box
from tracking3d.trackers.prompts.corrections import parse_correction
from tracking3d.trackers.prompts.points import parse_points
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source
from tracking3d.video.image_sequence import ImageSequence
from tracking3d.video.source import FrameSource

WORK = ".work"
"""Folder inside the batch folder for unfinished runs, from which retried videos resume."""
LOGS = "logs"
RUN = "run"
"""Name of the later run folder inside the work folder of a video."""

_ATTEMPTS = "attempts"
_TELL = 1.0  # seconds between two words about how far it is


def work_folder(out: str, job: VideoJob) -> Path:
    """The work folder of a video; another one for every setting, since a run resumes only with its own.

    Beside the results if they are on this machine, so that a worker elsewhere that sees the same files can resume;
    else in the machine's own folder for temporary files.
    """
    base = local(out)
    if base is None:
        base = Path(
            tempfile.gettempdir(), f"tracking3d-batch-{hashlib.sha256(out.encode()).hexdigest()[:12]}"
        )
    return base / WORK / f"{job.name.replace('/', '__')[-100:]}-{job.key}"


def log_file(out: str, job: VideoJob) -> Path:
    """The log of a worker: next to the results, or in its work folder if these are on other storage."""
    if (base := local(out)) is not None:
        return base / LOGS / f"{job.name}.log"
    return work_folder(out, job) / "log.txt"


def track_video(
    tell: Reporter,
    job: VideoJob,
    out: str,
    command: str,
    report: bool,
    networks: tuple[SharedNetwork, ...] = (),
) -> dict[str, Any]:
    """Track one video; returns the same as `tracking3d.batch.summary.write_marker`.

    A video that was begun before is resumed from its last finished frame, however it was stopped.

    Args:
        tell: Called with a mapping: ``frames``, the number of estimates, and ``of`` how many, if known; or ``stage``,
            the name of the stage that begins.
        job: The video.
        out: The folder of the batch.
        command: The command line, for the record.
        report: Whether to write a report.
        networks: What the machine may lack.

    Raises:
        Tracking3dError: If it cannot be tracked; finished frames are kept for the next attempt.
    """
    with local_work_folder(job, out, networks) as work, listen_to_progress(telling_stages(tell)):
        attempts = count_attempt(work)
        run = work / RUN
        _track(tell, fetch_inputs(job, work / "source"), run, command)
        return put_away(job, out, work, layout.runs_in(run), report, attempts)


@contextmanager
def local_work_folder(job: VideoJob, out: str, networks: tuple[SharedNetwork, ...] = ()) -> Iterator[Path]:
    """The work folder of a video; after an error it keeps what can be resumed.

    Args:
        job: The video.
        out: The folder of the batch.
        networks: What the machine may lack.

    Raises:
        OutputError: If it cannot be written.
    """
    work = work_folder(out, job)
    with writing(work):
        work.mkdir(parents=True, exist_ok=True)
    keep_networks(networks)
    try:
        yield work
    except BaseException as error:
        send_log(out, job)
        if isinstance(error, InputError) and not (work / RUN).exists():  # there is nothing to resume
            _forget(work)
        raise


def put_away(
    job: VideoJob, out: str, work: Path, runs: Sequence[Path], report: bool, attempts: int, note: str = ""
) -> dict[str, Any]:
    """Move a complete run into its place; returns the same as `tracking3d.batch.summary.write_marker`.

    Args:
        job: The video.
        out: The folder of the batch.
        work: The folder that it was worked on in, which is removed.
        runs: The run folders in there.
        report: Whether to write a report of each.
        attempts: How often the video was begun.
        note: A further remark.

    Raises:
        OutputError: If something cannot be written.
    """
    if report:
        from tracking3d.ui.report.several import write_reports

        write_reports(runs)
    marker = write_marker(work / RUN, job, attempts, runs, note)
    _put_into_place(work / RUN, join_path(out, job.name))
    send_log(out, job)
    _forget(work)
    return marker


def _track(tell: Reporter, job: VideoJob, run: Path, command: str) -> None:
    # Not before: the process that hands out the videos need not wait for what tracks.
    from tracking3d.pipeline.open_tracking import request_tracking
    from tracking3d.pipeline.record import RecordOptions, record_tracking

    source = _source(job)
    passes = 2 if job.config.solver.final_refine else 1
    whole = source.count and source.count * job.objects * passes
    listener = counting(tell, whole)
    boxes: list[Any] = [parse_box(text, box_format=job.box_format) for text in job.box]
    masks: list[Any] = [Path(file) for file in job.mask]
    points: list[Any] = [parse_points(text) for text in job.points]
    prompts = PromptSet(boxes, masks, points, job.start_frame, job.objects > 1, job.box_format)
    corrections = [parse_correction(text, job.box_format) for text in job.correct]
    request = request_tracking(source, job.config, prompts, corrections)
    record_tracking(request, run, RecordOptions(command, job.frames, resume=True), listener)


def counting(tell: Reporter, of: int | None, **about: Any) -> Callable[[FrameRecord | SkippedFrame], None]:
    """A listener that reports the number of estimates from time to time, at first zero."""
    done, last, process = 0, 0.0, os.getpid()

    def listener(frame: FrameRecord | SkippedFrame) -> None:
        nonlocal done, last
        done += 1
        if time.monotonic() - last > _TELL:
            last = time.monotonic()
            tell({"frames": done, "of": of, "process": process, **about})

    tell({"frames": 0, "of": of, "process": process, **about})
    return listener


def telling_stages(tell: Reporter) -> ProgressListener:
    """A listener that reports the name of each stage when it begins."""
    present = ""

    def listener(progress: StageProgress) -> None:
        nonlocal present
        if progress.name != present and not progress.inside:
            present = progress.name
            tell({"stage": present})

    return listener


def _source(job: VideoJob) -> FrameSource:
    if job.sequence is None:
        return open_source(job.video, job.frames)
    described, root, name = job.sequence
    frames = dataset_reader().read_sequence(described, Path(root), name).frames
    return ImageSequence(name, frames, range(len(frames)))


def fetch_inputs(job: VideoJob, folder: Path) -> VideoJob:
    """The same job with files that are elsewhere copied to this machine."""

    def here(place: str, number: int) -> str:
        if local(place) is not None:
            return absolute(place)
        return str(copy_to_local(place, folder / str(number)))

    if job.sequence is not None:
        return job
    tracker = job.config.tracker
    masks: str | None = getattr(tracker, "path", None)
    config = job.config
    if masks is not None and local(masks) is None:
        document = config.model_dump()
        document["tracker"]["path"] = here(masks, 0)
        config = PipelineConfig.model_validate(document)
    return replace(
        job,
        video=here(job.video, 1),
        mask=tuple(here(one, number) for number, one in enumerate(job.mask, 2)),
        config=config,
    )


def _put_into_place(run: Path, place: str) -> None:
    """Move a complete run folder into its place, replacing one that is there."""
    target = local(place)
    if target is None:
        remove(place)
        send(run, place, MARKER)
        return
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        before = run.with_name("before")
        if target.exists():
            shutil.rmtree(before, ignore_errors=True)
            target.rename(before)
        run.rename(target)


def send_log(out: str, job: VideoJob) -> bool:
    """Upload the log next to results on other storage; returns whether this machine has it."""
    log = log_file(out, job)
    if local(out) is None and log.is_file():
        with suppress(OutputError):  # the results are what counts
            write(join_path(out, LOGS, f"{job.name}.log"), log.read_bytes())
    return log.is_file()


def count_attempt(work: Path) -> int:
    """How often a video has been begun, with this time."""
    times = count_earlier_attempts(work) + 1
    write_atomic(work / _ATTEMPTS, str(times).encode())
    return times


def count_earlier_attempts(work: Path) -> int:
    """How often a video has been begun; 0 if a full disk has truncated the note."""
    with suppress(OSError, ValueError):
        return int((work / _ATTEMPTS).read_text())
    return 0


def _forget(work: Path) -> None:
    shutil.rmtree(work, ignore_errors=True)
