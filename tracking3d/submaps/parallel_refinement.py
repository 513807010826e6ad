"""The last steps of a merged run's final refinement, taken by several processes: adjustment, then poses, then masks.

Each process takes its range of frames through `tracking3d.pipeline.refinement_steps.RefinementSteps`. The adjustment,
and what masks have in common, are computed once, for all frames; what they say of a frame depends only on frames a few
frames away.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2

from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.refinement_steps import Decision, RefinementSteps
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment
from tracking3d.rendering.backend import share_threads
from tracking3d.results import layout
from tracking3d.results.files import mask_file
from tracking3d.results.probabilities import write_probability
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.runtime.concurrency import read_ahead
from tracking3d.segmentation.temporal_neighbours import REACH
from tracking3d.segmentation.whole_video import VideoSegmenter
from tracking3d.submaps.merged_run import move_refined_estimates
from tracking3d.submaps.submap_runs import Revisit, Tell, resume_retracking, resume_submap
from tracking3d.video import open_source
from tracking3d.video.selection import parse_selection


@dataclass(frozen=True, eq=False)
class Settling:
    """Refined estimates of all parts, to be merged."""

    looks: Sequence[Revisit]  # the frames that were looked at, by parts, in order of time
    seconds: float  # what the refinement took until then


@dataclass(frozen=True, eq=False)
class Placing:
    """Frames of one part, to get their final poses."""

    job: Revisit  # the frames
    look: GlobalAdjustment  # what all frames say together


@dataclass(frozen=True, eq=False)
class Weighing:
    """Frames, to get their final masks."""

    job: Revisit  # the frames; those of the whole video when masks are collected
    estimates: Mapping[int, FrameRecord]  # those of the whole video with their final poses, by frame index
    look: GlobalAdjustment  # what all frames say together
    # the masks of frames that were estimated again after the adjustment, as PNG, by index
    retracked: Mapping[int, bytes]
    # what the masks of all frames have in common; None when that is to be found
    masks: VideoSegmenter | None = None


def solve_together(tell: Tell, job: Settling) -> GlobalAdjustment:
    """Write the refined estimates of all parts into the run, and adjust poses, lens and surface by all of them.

    Raises:
        Tracking3dError: If something cannot be read or written.
    """
    first = job.looks[0]
    kept, session = resume_submap(first)
    if kept.progress.last_refined < kept.progress.last:  # not in their places yet
        move_refined_estimates(first.folder, session, [look.out for look in job.looks], job.seconds)
    estimates = _estimates(first.folder, session.camera)
    most = session.config.object.adjustment_views
    look = GlobalAdjustment(session.result(), session.camera, sorted(estimates.causal), most)
    last = RefinementSteps(estimates, look)
    for frame in _frames(first.source, first.whole, estimates):
        last.collect(frame)
    with share_threads(cv2.getNumThreads()):
        last.adjust_all()
    return look


def adjust_poses(tell: Tell, job: Placing) -> tuple[list[FrameRecord], dict[int, bytes]]:
    """The estimates of some frames with their adjusted poses, and the masks of those that were estimated again.

    Raises:
        Tracking3dError: If something cannot be read.
    """
    estimates = _estimates(job.job.folder, job.look.camera)
    retracking = resume_retracking(job.job, *resume_submap(job.job))
    last = RefinementSteps(estimates, job.look, retracking=retracking)
    found, own = list[FrameRecord](), parse_selection(job.job.selection)
    before = max(own.start - own.step, parse_selection(job.job.whole).start)
    for frame in _frames(job.job.source, f"{before}:{own.stop}:{own.step}", estimates):
        if frame.index in own:
            found.append(last.adjust(frame))
        elif (record := estimates.estimate(frame.index)).refined:
            retracking.pass_over(frame, record.T_cam_obj)
    return found, last.retracked


def put_together(tell: Tell, job: Weighing) -> VideoSegmenter:
    """What the masks of all frames have in common.

    Raises:
        Tracking3dError: If something cannot be read.
    """
    estimates = _estimates(job.job.folder, job.look.camera)
    last = RefinementSteps(estimates, job.look)
    last.begin_masks(job.job.config)  # before poses are adjusted, as in one process
    for record in job.estimates.values():
        estimates.put(record, job.retracked.get(record.index))
    for frame in _frames(job.job.source, job.job.whole, estimates):
        last.collect_mask(frame)
    last.settle_masks()
    assert last.masks is not None
    return last.masks


def weigh(tell: Tell, job: Weighing) -> dict[int, bytes]:
    """The final masks of some frames, as PNG files, by index; those that stand are left out.

    Raises:
        Tracking3dError: If something cannot be read, or a probability not be written.
    """
    folder, own, found = job.job.folder, parse_selection(job.job.selection), dict[int, bytes]()
    estimates = _estimates(folder, job.look.camera)
    for record in job.estimates.values():
        estimates.put(record, job.retracked.get(record.index))
    for frame, decided in _decisions(job, estimates, own):
        if decided is not None and frame.index in own:
            found[frame.index] = mask_file(decided.mask)
            if estimates.writes_probabilities:
                write_probability(folder / layout.REFINING, frame.index, decided.probability)
    return found


def _decisions(job: Weighing, estimates: RefinedEstimates, own: range) -> Iterator[Decision]:
    """Estimates of a part's frames, and of the frames before and after, for their motion."""
    last = RefinementSteps(estimates, job.look, job.masks)
    reach = 2 * REACH * own.step
    whole = parse_selection(job.job.whole)
    start, stop = max(own.start - reach, whole.start), min(own.stop + reach, whole.stop)
    for frame in _frames(job.job.source, f"{start}:{stop}:{own.step}", estimates):
        yield from last.decide(frame)
    yield from last.decide_rest()


def _estimates(folder: Path, camera: Camera) -> RefinedEstimates:
    return RefinedEstimates.of_folder(folder, (camera.height, camera.width))


def _frames(source: str, selection: str | None, estimates: RefinedEstimates) -> Iterator[Frame]:
    """The frames that have an estimate."""
    with closing(read_ahead(open_source(source, selection))) as frames:
        for frame in frames:
            if isinstance(frame, Frame) and frame.index in estimates.causal:
                yield frame
