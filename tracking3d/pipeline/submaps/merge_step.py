"""The last steps of a long video: its parts become one object and one run, which ends as any run does."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tracking3d.config.models import OnlineConfig, PipelineConfig
from tracking3d.engines.protocol import Reporter
from tracking3d.estimation.online.atlas import transform_map
from tracking3d.estimation.online.mapping.global_refinement import keyframe_cost
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import Initializing, Mapped
from tracking3d.estimation.segmentation.temporal_neighbours import REACH
from tracking3d.estimation.segmentation.whole_video import VideoSegmenter
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays
from tracking3d.geometry.similarity import Similarity
from tracking3d.pipeline.components import build_encoder
from tracking3d.pipeline.frame_reading import FrameOrder
from tracking3d.pipeline.open_tracking import OpenTracking, TrackRequest, open_tracking, request_tracking
from tracking3d.pipeline.passes import run_refinement, running
from tracking3d.pipeline.record import RecordOptions, begin_recording
from tracking3d.pipeline.refinement_steps import Decision, PrecomputedRefinement, RefinementSteps
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.submaps.alignment import (
    DisagreementError,
    SubmapAlignment,
    align_submaps,
    by_lens,
    fit_similarity,
    merge_states,
)
from tracking3d.pipeline.submaps.merged_run import (
    PartRun,
    move_refined_estimates,
    write_causal_mesh,
    write_merged_run,
)
from tracking3d.pipeline.submaps.plan import (
    PARTS,
    Plan,
    PlannedVideo,
    part_folder,
    put_cut_mask,
    remove_parts,
)
from tracking3d.pipeline.submaps.submap_runs import (
    PartJob,
    Revisit,
    frames_with_the_one_before,
    resume_retracking,
    resume_submap,
)
from tracking3d.reconstruction.final_shape import make_final_shape
from tracking3d.reconstruction.global_adjustment import GlobalAdjustment
from tracking3d.rendering.backend import share_threads
from tracking3d.results import layout
from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.resuming import prompt_record
from tracking3d.results.description import RunHeader
from tracking3d.results.files import mask_file, write_probability
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import apply_object_size
from tracking3d.results.run_writer import RunWriter
from tracking3d.runtime.concurrency import read_ahead
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source
from tracking3d.video.source import parse_selection

_log = logging.getLogger(__name__)
_SAME_OBJECT = 0.5
"""If less than this share of the smaller of two masks lies within the other, a part began on something else than the
part before ends with. One of them may well have lost a side of the object."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A video whose parts have their causal estimates."""

    planned: PlannedVideo  # the video
    jobs: tuple[PartJob, ...]  # its parts, as they were tracked last
    again: tuple[int, ...] = ()  # numbers of the parts that were tracked again
    seconds: float = 0.0  # what tracking the parts took


@dataclass(frozen=True, eq=False)
class Retrack:
    """A part that began on something else and is to be tracked once more."""

    number: int
    job: PartJob


@dataclass(frozen=True)
class MergeFailure:
    """Why parts cannot be merged."""

    reason: str


@dataclass(frozen=True, eq=False)
class MergedSubmaps:
    """A video whose parts are one run, but for its second estimates."""

    planned: PlannedVideo  # the video
    revisits: tuple[Revisit, ...]  # frames to be refined, by parts
    about: Mapping[str, Any]  # the section split of run.json
    seconds: Mapping[str, float] = field(default_factory=dict)  # what each step took, by name


def merge_parts(tell: Reporter, tracked: Tracked) -> Retrack | MergeFailure | MergedSubmaps:
    """Merge the parts into one run, up to the refinement of all frames.

    Raises:
        Tracking3dError: If something cannot be read or written; the frames finished until then are saved.
    """
    planned, clock = tracked.planned, time.monotonic()
    video = planned.video
    if (again := _find_running(tracked)) is not None:
        return again
    with open_tracking(_request(planned)) as opened:
        session = opened.objects[0].session
    try:
        whole = merge_submaps(session, planned.config, planned.plan, video.folder)
    except DisagreementError as error:
        _log.warning("The parts could not be merged: %s.", error)
        return MergeFailure(str(error))
    seconds = {"preview": planned.plan.seconds, "parts": tracked.seconds}
    seconds["merge"], clock = time.monotonic() - clock, time.monotonic()
    about = {
        "workers": video.workers,
        "parts": [[run.part.start, run.part.stop] for run in whole.runs],
        "preview_frames": planned.plan.preview_frames,
        "retracked": list(tracked.again),
        "alignments": whole.alignments,
        "cost_ratio": whole.cost_ratio,
    }
    writer = _begin_writing(planned, opened, whole)
    owned = _owned_ranges(planned)
    session.load_state_dict(opened.first, whole.session, {})
    write_causal_mesh(video.folder, session)
    session.refine()
    write_merged_run(writer, session, whole.runs, owned, sum(seconds.values()) + time.monotonic() - clock)
    seconds["refine"] = time.monotonic() - clock
    note_in_run(video.folder, {"split": {**about, "seconds": seconds}})
    return MergedSubmaps(planned, _revisits(planned, owned), about, seconds)


@dataclass(frozen=True, eq=False)
class FinishJob:
    """A video whose frames are all estimated, to be drawn."""

    merged: MergedSubmaps  # the run; its seconds are those of all steps
    precomputed: PrecomputedRefinement  # what the last steps of its final refinement come to


def finish_run(tell: Reporter, job: FinishJob) -> None:
    """Draw the estimates, and write the final files; the parts are removed.

    Args:
        tell: Called with the estimates that are drawn.
        job: All that is known.

    Raises:
        Tracking3dError: If something cannot be read or written; the frames finished until then are saved.
    """
    planned = job.merged.planned
    video, config = planned.video, planned.config
    about = {**job.merged.about, "seconds": dict(job.merged.seconds)}
    note_in_run(video.folder, {"split": about})
    options = RecordOptions(video.command, video.selection, resume=True)
    with open_tracking(_request(planned)) as opened, ExitStack() as writers:
        opened = replace(opened, tracker_choice=planned.choice)
        recording = begin_recording(opened, 0, video.folder, options, writers)
        if recording is not None:
            recording.precomputed = job.precomputed
            with running(opened.source, [recording], tell) as active:  # every frame has its causal estimate
                run_refinement(opened.source, active)
    if recording is not None:
        make_final_shape(video.folder, config, opened.source)
    apply_object_size(video.folder, config.object)
    remove_parts(video.folder)


def _request(planned: PlannedVideo) -> TrackRequest:
    """The whole video, with the mask tracker that was chosen."""
    video = planned.video
    source = open_source(video.source, video.selection)
    return request_tracking(source, planned.config, video.prompts, skip_damaged=True)


def _find_running(tracked: Tracked) -> Retrack | None:
    """The first part that began on something else than the part before ends with, and was not tracked again yet."""
    planned = tracked.planned
    folder, whole = planned.video.folder, planned.video.frames(planned.count)
    checked = max(tracked.again, default=0)
    for before, part in zip(planned.plan.parts, planned.plan.parts[1:], strict=False):
        if part.number <= checked:
            continue
        cut = whole[part.start]
        earlier = RunReader(part_folder(folder, before), refined=False)
        estimates = {one.index: one for one in earlier.frames}
        prompts = tracked.jobs[part.number].prompts
        began = prompts.masks[0] if prompts.masks else None
        if (
            cut not in estimates
            or estimates[cut].status != "tracked"
            or began is None
            or isinstance(began, Path)
        ):
            continue
        estimate = earlier.mask(cut)
        smaller = min(estimate.sum(), began.sum())
        if smaller and np.count_nonzero(estimate & began) < _SAME_OBJECT * smaller:
            _log.warning("Part %d began on something else and is tracked again.", part.number + 1)
            put_cut_mask(folder, part, estimate)
            job = replace(tracked.jobs[part.number], prompts=PromptSet.of_one(mask=estimate), resume=False)
            return Retrack(part.number, job)
    return None


def _owned_ranges(planned: PlannedVideo) -> list[range]:
    """Indices of the frames whose estimates are taken from each part."""
    whole = planned.video.frames(planned.count)
    starts = [part.owns_from for part in planned.plan.parts]
    return [whole[start:stop] for start, stop in zip(starts, [*starts[1:], len(whole)], strict=True)]


def _begin_writing(planned: PlannedVideo, opened: OpenTracking, whole: MergedMap) -> RunWriter:
    """The writer of the merged run, with the header of a run before its first frame."""
    video, source, [one] = planned.video, opened.source, opened.objects
    header = RunHeader(
        config=planned.config.model_dump(mode="json"),
        camera=whole.camera,
        source=source.name,
        seed=planned.config.runtime.seed,
        renderer=one.session.renderer,
        fps=source.fps,
        command=video.command,
        selection=video.selection,
        prompt=prompt_record(opened.first, one.prompt, source.count),
        tracker_choice=planned.choice,
    )
    return RunWriter(video.folder, header, overwrite=True)


def _revisits(planned: PlannedVideo, owned: Sequence[range]) -> tuple[Revisit, ...]:
    video = planned.video
    return tuple(
        Revisit(
            video.source,
            video.selection,
            f"{mine.start}:{mine[-1] + 1}:{mine.step}",
            planned.config,
            video.folder,
            video.prompts,
            video.folder / PARTS / f"second_{part.number}",
        )
        for part, mine in zip(planned.plan.parts, owned, strict=True)
    )


MAX_COST_RATIO = 1.75
"""Largest ratio of the cost of the keyframes after merging to their cost before; see `keyframe_cost`."""
_FEWEST_KEYFRAMES = 3
_SAME_LENS = math.log(1.05)


@dataclass(frozen=True, eq=False)
class MergedMap:
    """The merged map of all parts."""

    runs: Sequence[PartRun]  # the parts, each with its similarity to the merged object
    session: Mapping[str, Any]  # the state of a session that has seen all of them
    camera: Camera  # the camera of the causal estimates
    alignments: Sequence[Mapping[str, Any]]  # a description of each alignment, for run.json
    cost_ratio: float  # cost of the keyframes after merging, divided by their cost in their own parts


def merge_submaps(session: Session, config: PipelineConfig, plan: Plan, folder: Path) -> MergedMap:
    """Merge the tracked parts.

    Args:
        session: A new session for the whole video.
        config: The pipeline.
        plan: The parts.
        folder: The run folder.

    Raises:
        DisagreementError: If they cannot be merged.
        InputError: If a part's folder is damaged.
    """
    assert isinstance(config.solver, OnlineConfig)
    tracked, object_map = _read_submaps(session, config, plan, folder)
    encoder = build_encoder(config)
    tried: list[_Try] = []
    refused: list[DisagreementError] = []
    lenses = _lenses(object_map)
    for camera in lenses:
        try:
            tried.append(_try_alignment(camera, tracked, object_map, config.solver, encoder))
        except DisagreementError as error:
            refused.append(error)
    if not tried:
        raise DisagreementError(f"{refused[0]}{_of_lenses(lenses)}") from refused[0]
    best = min(tried, key=lambda one: one.cost_ratio)
    runs, updated = best.runs, best.merged
    settled = [
        replace(run, similarity=_refine_alignment(updated.object_map, own.object_map, similarity))
        for run, own, similarity in zip(runs, best.states, best.similarities, strict=True)
    ]
    first, last = runs[0].kept.session, max(record.index for run in runs for record in run.records)
    first_pose, presented, _, restarted = first["steering"]
    state = {
        **first,
        "solver": updated,
        "camera": updated.camera,
        "steering": (first_pose, FrameOrder(presented.first), last, restarted),
    }
    return MergedMap(
        settled,
        state,
        updated.camera,
        [_describe(alignment) for alignment in best.alignments],
        best.cost_ratio,
    )


@dataclass(frozen=True, eq=False)
class _Try:
    """The parts merged with one focal length, with their runs and states converted to it."""

    runs: Sequence[PartRun]
    states: Sequence[Mapped]
    alignments: Sequence[SubmapAlignment]
    similarities: Sequence[Similarity]
    merged: Mapped
    cost_ratio: float


def _lenses(states: Sequence[Mapped]) -> list[Camera]:
    """The different cameras of the parts: if the focal length is not given, each part estimated its own."""
    lenses: list[Camera] = []
    for state in states:
        if all(abs(math.log(state.camera.fy / other.fy)) > _SAME_LENS for other in lenses):
            lenses.append(state.camera)
    return lenses


def _of_lenses(lenses: Sequence[Camera]) -> str:
    """Advice if the focal lengths differ: parts with a given one agree more often."""
    if len(lenses) < 2:
        return ""
    degrees = sorted(one.fov for one in lenses)
    return (
        f"; each part estimated its own focal length (vertical fields of view of {degrees[0]:.0f} to "
        f"{degrees[-1]:.0f} degrees), "
        "giving it by --fov or --intrinsics may help"
    )


def _try_alignment(
    camera: Camera,
    runs: Sequence[PartRun],
    states: Sequence[Mapped],
    config: OnlineConfig,
    encoder: FeatureEncoder,
) -> _Try:
    seen = [by_lens(state, run.records, camera) for state, run in zip(states, runs, strict=True)]
    by_it = [state for state, _ in seen]
    own = [replace(run, records=records) for run, (_, records) in zip(runs, seen, strict=True)]
    alignments = [
        _align_pair(number, by_it[number - 1 : number + 1], own[number - 1 : number + 1])
        for number in range(1, len(own))
    ]
    similarities = [Similarity.identity()]
    for alignment in alignments:
        similarities.append(similarities[-1].after(alignment.fit.similarity))
    state, cost_ratio = merge_submap_states(by_it, similarities, config, encoder, states)
    return _Try(own, by_it, alignments, similarities, state, cost_ratio)


def merge_submap_states(
    states: Sequence[Mapped],
    similarities: Sequence[Similarity],
    config: OnlineConfig,
    encoder: FeatureEncoder,
    before: Sequence[Mapped] | None = None,
) -> tuple[Mapped, float]:
    """Merge the states of the parts; also returns the cost ratio of their keyframes; see
    `tracking3d.pipeline.submaps.alignment.merge_states`.

    Args:
        states: States of the parts, all with one camera.
        similarities: From each part's object to the first one's.
        config: The solver's configuration.
        encoder: The feature encoder.
        before: The parts' own states, each with its own camera, for their cost before merging.

    Raises:
        DisagreementError: If the merged map explains the keyframes far worse than the parts do.
    """
    own = float(np.mean([keyframe_cost(state.object_map) for state in before or states]))
    state = merge_states(states, similarities, config, encoder)
    together = keyframe_cost(state.object_map)
    if together > MAX_COST_RATIO * own:
        raise DisagreementError(
            f"one object explains their keyframes {together / own:.1f} times as badly as one object each"
        )
    return state, together / own


def _read_submaps(
    session: Session, config: PipelineConfig, plan: Plan, folder: Path
) -> tuple[list[PartRun], list[Mapped]]:
    """The parts with their states, each with its own camera."""
    runs: list[PartRun] = []
    states: list[Mapped] = []
    for part in plan.parts:
        own = part_folder(folder, part)
        kept = Checkpoint(own, session.state_classes, config.runtime.device).read()
        state = kept.session["solver"]
        if isinstance(state, Initializing):
            why = state.waiting_reason or "the object did not move enough in it"
            raise DisagreementError(f"the shape could not be initialized in part {part.number + 1} ({why})")
        records = RunReader(own, refined=False).frames
        states.append(state)
        runs.append(PartRun(part, own, kept, records, Similarity.identity()))
    return runs, states


def _align_pair(number: int, states: Sequence[Mapped], runs: Sequence[PartRun]) -> SubmapAlignment:
    try:
        return align_submaps(states[0], states[1], runs[0].records, runs[1].records)
    except DisagreementError as error:
        raise DisagreementError(f"parts {number} and {number + 1}: {error}") from error


def _refine_alignment(object_map: ObjectMap, own: ObjectMap, similarity: Similarity) -> Similarity:
    """The similarity of a part to the merged object after the refinement moved its keyframes."""
    after = {view.index: view.pose for view in object_map.keyframes}
    before = {view.index: view.pose for view in transform_map(own, similarity).keyframes}
    common = sorted(before.keys() & after.keys())
    if len(common) < _FEWEST_KEYFRAMES:
        return similarity
    poses = []
    for side in (after, before):
        T = np.tile(np.eye(4), (len(common), 1, 1))
        for n, index in enumerate(common):
            T[n, :3, :3], T[n, :3, 3] = pose_arrays(side[index])
        poses.append(T)
    fit = fit_similarity(poses[0], poses[1], own_points(object_map), own_points(object_map))
    return fit.similarity.after(similarity)


def own_points(object_map: ObjectMap) -> np.ndarray:
    """``(V, 3)`` vertices of a map, which constrain a small change of coordinates to the object."""
    return np.asarray(object_map.vertices.double().cpu().numpy())


def _describe(alignment: SubmapAlignment) -> dict[str, Any]:
    fit = alignment.fit
    return {
        "frames": alignment.frames,
        "landmarks": alignment.landmarks,
        "degrees": float(np.median(fit.angles)),
        "distance": float(np.median(fit.distances)),
        "scale": fit.similarity.scale,
        "scale_error": fit.scale_error,
    }


# The last steps of a merged run's final refinement, taken by several processes: adjustment, then poses, then masks.
#
# Each process takes its range of frames through `tracking3d.pipeline.refinement_steps.RefinementSteps`. The adjustment,
# and what masks have in common, are computed once, for all frames; what they say of a frame depends only on frames a
# few frames away.


@dataclass(frozen=True, eq=False)
class AdjustJob:
    """Refined estimates of all parts, to be merged."""

    revisits: Sequence[Revisit]  # the frames that were looked at, by parts, in order of time
    seconds: float  # what the refinement took until then


@dataclass(frozen=True, eq=False)
class PoseJob:
    """Frames of one part, to get their final poses."""

    job: Revisit  # the frames
    look: GlobalAdjustment  # what all frames say together


@dataclass(frozen=True, eq=False)
class MaskJob:
    """Frames, to get their final masks."""

    job: Revisit  # the frames; those of the whole video when masks are collected
    estimates: Mapping[int, FrameRecord]  # those of the whole video with their final poses, by frame index
    look: GlobalAdjustment  # what all frames say together
    # the masks of frames that were estimated again after the adjustment, as PNG, by index
    retracked: Mapping[int, bytes]
    # what the masks of all frames have in common; None when that is to be found
    masks: VideoSegmenter | None = None


def solve_together(tell: Reporter, job: AdjustJob) -> GlobalAdjustment:
    """Write the refined estimates of all parts into the run, and adjust poses, lens and surface by all of them.

    Raises:
        Tracking3dError: If something cannot be read or written.
    """
    first = job.revisits[0]
    kept, session = resume_submap(first)
    if kept.progress.last_refined < kept.progress.last:  # not in their places yet
        move_refined_estimates(first.folder, session, [one.out for one in job.revisits], job.seconds)
    estimates = _estimates(first.folder, session.camera)
    most = session.config.object.adjustment_views
    look = GlobalAdjustment(session.result(), session.camera, sorted(estimates.causal), most)
    last = RefinementSteps(estimates, look)
    for frame in _frames(first.source, first.whole, estimates):
        last.collect(frame)
    with share_threads(cv2.getNumThreads()):
        last.adjust_all()
    return look


def adjust_poses(tell: Reporter, job: PoseJob) -> tuple[list[FrameRecord], dict[int, bytes]]:
    """The estimates of some frames with their adjusted poses, and the masks of those that were estimated again.

    Raises:
        Tracking3dError: If something cannot be read.
    """
    estimates = _estimates(job.job.folder, job.look.camera)
    retracking = resume_retracking(job.job, *resume_submap(job.job))
    last = RefinementSteps(estimates, job.look, retracking=retracking)
    found, (own, selection) = list[FrameRecord](), frames_with_the_one_before(job.job)
    for frame in _frames(job.job.source, selection, estimates):
        if frame.index in own:
            found.append(last.adjust(frame))
        elif (record := estimates.estimate(frame.index)).refined:
            retracking.pass_over(frame, record.T_cam_obj)
    return found, last.retracked


def collect_masks(tell: Reporter, job: MaskJob) -> VideoSegmenter:
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


def decide_masks(tell: Reporter, job: MaskJob) -> dict[int, bytes]:
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


def _decisions(job: MaskJob, estimates: RefinedEstimates, own: range) -> Iterator[Decision]:
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
