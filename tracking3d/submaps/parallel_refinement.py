"""What a joined run's answers become in the end, found side by side: poses by all points, then masks by all images.

It is what `tracking3d.pipeline.refinement_pass` does frame by frame in one process. Points are bundled and masks put
together once; what that says of a frame does not hang on the frames of other parts, but for those a few frames away.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Frame
from tracking3d.pipeline.refinement_pass import adjust_pose
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment
from tracking3d.reconstruction.mask_refinement import Decision, Masked, MaskRefinement
from tracking3d.rendering.backend import share_threads
from tracking3d.results import layout
from tracking3d.results.files import mask_file, read_mask
from tracking3d.results.probabilities import write_probability
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.runtime.concurrency import read_ahead
from tracking3d.segmentation.temporal_neighbours import REACH
from tracking3d.submaps.merged_run import take_second_answers
from tracking3d.submaps.submap_runs import Revisit, Tell, resume_submap
from tracking3d.video import open_source
from tracking3d.video.selection import parse_selection

Answers = Mapping[int, FrameRecord]


@dataclass(frozen=True, eq=False)
class Settling:
    """Second answers of all parts, to be put together.

    Attributes:
        looks: The frames that were looked at, by parts, in order of time.
        seconds: What the refinement took until then.
    """

    looks: Sequence[Revisit]
    seconds: float


@dataclass(frozen=True, eq=False)
class Placing:
    """Frames of one part, to get their poses of the end.

    Attributes:
        job: The frames.
        look: What all frames say together.
    """

    job: Revisit
    look: GlobalAdjustment


@dataclass(frozen=True, eq=False)
class Weighing:
    """Frames, to get their masks of the end.

    Attributes:
        job: The frames; those of the whole video where masks are put together.
        answers: The whole video's, poses of the end.
        masks: What was put together; None where that is to be done.
        look: What all frames say together.
    """

    job: Revisit
    answers: Answers
    look: GlobalAdjustment
    masks: MaskRefinement | None = None


def solve_together(tell: Tell, job: Settling) -> GlobalAdjustment:
    """Put the second answers of all parts into the run, and together what they say of poses, lens and surface.

    Raises:
        Tracking3dError: If something cannot be read or written.
    """
    first = job.looks[0]
    kept, session = resume_submap(first)
    if kept.progress.last_refined < kept.progress.last:  # not in their places yet
        take_second_answers(first.folder, session, [look.out for look in job.looks], job.seconds)
    estimates = _answers(first.folder)
    look = GlobalAdjustment(
        session.result(), session.camera, sorted(estimates), session.config.object.adjustment_views
    )
    for frame in _frames(first.source, first.whole, estimates):
        if estimates[frame.index].refined and look.wants(frame.index):
            look.see(estimates[frame.index], frame.image, _mask(first.folder, estimates[frame.index], frame))
    with share_threads(cv2.getNumThreads()):
        look.settle()
    return look


def adjust_poses(tell: Tell, job: Placing) -> list[FrameRecord]:
    """The answers for some frames with the poses that they have in the end.

    Raises:
        Tracking3dError: If something cannot be read.
    """
    folder = job.job.folder
    estimates = _answers(folder)
    return [
        adjust_pose(
            estimates[frame.index], job.look, frame.image, _mask(folder, estimates[frame.index], frame)
        )
        for frame in _frames(job.job.source, job.job.selection, estimates)
    ]


def put_together(tell: Tell, job: Weighing) -> MaskRefinement:
    """What all masks say together.

    Raises:
        Tracking3dError: If something cannot be read.
    """
    estimates = job.answers
    before = _answers(job.job.folder)  # which masks are believed is decided before poses are put right
    masks = MaskRefinement(
        job.look.camera, job.look.vertices_of_landmarks, job.look.faces, list(before.values())
    )
    for frame in _frames(job.job.source, job.job.whole, estimates):
        if masks.wants(frame.index):
            masks.see(_frame_mask(job.job.folder, estimates[frame.index], frame))
    masks.settle()
    return masks


def weigh(tell: Tell, job: Weighing) -> dict[int, bytes]:
    """The masks that some frames have in the end, as PNG files, by index; those that stand are left out.

    Raises:
        Tracking3dError: If something cannot be read, or a probability not be written.
    """
    assert job.masks is not None
    folder, own, found = job.job.folder, parse_selection(job.job.selection), dict[int, bytes]()
    likely = (folder / layout.PROBABILITIES).is_dir()
    for masked, decided in _decisions(job, job.masks, own):
        index = masked.frame.index
        if decided is not None and index in own:
            found[index] = mask_file(decided.mask)
            if likely:
                write_probability(folder / layout.REFINING, index, decided.probability)
    return found


def _decisions(job: Weighing, masks: MaskRefinement, own: range) -> Iterator[Decision]:
    """Those of a part's frames, and of the frames before and after that tell their motion."""
    reach = 2 * REACH * own.step
    whole = parse_selection(job.job.whole)
    start, stop = max(own.start - reach, whole.start), min(own.stop + reach, whole.stop)
    for frame in _frames(job.job.source, f"{start}:{stop}:{own.step}", job.answers):
        yield from masks.decide(_frame_mask(job.job.folder, job.answers[frame.index], frame))
    yield from masks.rest()


def _frames(source: str, selection: str | None, estimates: Answers) -> Iterator[Frame]:
    with closing(read_ahead(open_source(source, selection))) as frames:
        for frame in frames:
            if isinstance(frame, Frame) and frame.index in estimates:
                yield frame


def _answers(folder: Path) -> dict[int, FrameRecord]:
    """The second answer of every frame, or the causal one where there is none."""
    causal = {one.index: one for one in RunReader(folder, refined=False).frames}
    return causal | {one.index: one for one in read_records(folder / layout.REFINING / layout.FRAMES)}


def _frame_mask(folder: Path, estimate: FrameRecord, frame: Frame) -> Masked:
    initial = read_mask(layout.initial_mask_path(folder, frame.index))
    return Masked(frame, estimate, initial, _mask(folder, estimate, frame))


def _mask(folder: Path, estimate: FrameRecord, frame: Frame) -> NDArray[np.bool_]:
    mask = read_mask(layout.mask_path(folder / layout.REFINING if estimate.refined else folder, frame.index))
    return np.zeros(frame.size, bool) if mask is None else mask
