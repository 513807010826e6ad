"""Merging the submaps of a video into one map, in the coordinates of the first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.checkpoint.folder import Checkpoint
from tracking3d.config.models import PipelineConfig
from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online.atlas.map_merging import transform_map
from tracking3d.estimation.online.mapping.global_refinement import keyframe_cost
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays
from tracking3d.geometry.similarity import Similarity
from tracking3d.pipeline.components import build_encoder
from tracking3d.pipeline.frame_order import FrameOrder
from tracking3d.pipeline.session import Session
from tracking3d.results.run_reader import RunReader
from tracking3d.submaps.alignment import DisagreementError, SubmapAlignment, align_submaps, by_lens
from tracking3d.submaps.merged_run import PartRun
from tracking3d.submaps.plan import Plan, part_folder
from tracking3d.submaps.similarity import fit_similarity
from tracking3d.submaps.state_merging import merge_states

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
    states: Sequence[SolverState]
    alignments: Sequence[SubmapAlignment]
    similarities: Sequence[Similarity]
    merged: SolverState
    cost_ratio: float


def _lenses(states: Sequence[SolverState]) -> list[Camera]:
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
    states: Sequence[SolverState],
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
    states: Sequence[SolverState],
    similarities: Sequence[Similarity],
    config: OnlineConfig,
    encoder: FeatureEncoder,
    before: Sequence[SolverState] | None = None,
) -> tuple[SolverState, float]:
    """Merge the states of the parts; also returns the cost ratio of their keyframes; see
    `tracking3d.submaps.state_merging.merge_states`.

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
) -> tuple[list[PartRun], list[SolverState]]:
    """The parts with their states, each with its own camera."""
    runs: list[PartRun] = []
    states: list[SolverState] = []
    for part in plan.parts:
        own = part_folder(folder, part)
        kept = Checkpoint(own, session.state_classes, config.runtime.device).read()
        state = kept.session["solver"]
        if state.pending is not None:
            why = state.waiting_reason or "the object did not move enough in it"
            raise DisagreementError(f"the shape could not be initialized in part {part.number + 1} ({why})")
        records = RunReader(own, refined=False).frames
        states.append(state)
        runs.append(PartRun(part, own, kept, records, Similarity.identity()))
    return runs, states


def _align_pair(number: int, states: Sequence[SolverState], runs: Sequence[PartRun]) -> SubmapAlignment:
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
