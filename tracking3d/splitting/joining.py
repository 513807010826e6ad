"""The parts of a video as one object: how each lies in the first, and what they know together."""

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
from tracking3d.estimation.online.belief import Belief, ObjectMap
from tracking3d.estimation.online.final_refinement import keyframe_cost
from tracking3d.estimation.online.mapping import pose_arrays
from tracking3d.estimation.online.uniting import moved
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.similarity import Similarity
from tracking3d.parts import build_encoder
from tracking3d.presented import Presented
from tracking3d.results.run_reader import RunReader
from tracking3d.session import Session
from tracking3d.splitting.agreement import DisagreementError, Joint, by_lens, joint_of
from tracking3d.splitting.joined_run import PartRun
from tracking3d.splitting.map_joining import merge_states
from tracking3d.splitting.plan import Plan, part_folder
from tracking3d.splitting.similarity import fit_similarity

MOST_DEARER = 1.75
"""How many times what the parts' keyframes cost by themselves they may cost together; see `keyframe_cost`."""
_FEWEST_KEYFRAMES = 3
_SAME_LENS = math.log(1.05)


@dataclass(frozen=True, eq=False)
class Whole:
    """All parts as one.

    Attributes:
        runs: The parts, with how each lies in the joined object.
        session: The state of a session that has seen all of them.
        camera: Of the causal answers.
        joints: What is known of each joint, for the record.
        dearer: How many times what they cost by themselves the keyframes cost together.
    """

    runs: Sequence[PartRun]
    session: Mapping[str, Any]
    camera: Camera
    joints: Sequence[Mapping[str, Any]]
    dearer: float


def joined_parts(session: Session, config: PipelineConfig, plan: Plan, folder: Path) -> Whole:
    """Join the parts that are tracked.

    Args:
        session: For the whole video, which has seen nothing yet.
        config: The pipeline.
        plan: The parts.
        folder: The run folder.

    Raises:
        DisagreementError: If they cannot be joined.
        InputError: If a part's folder is damaged.
    """
    assert isinstance(config.solver, OnlineConfig)
    tracked, known = _read(session, config, plan, folder)
    encoder = build_encoder(config)
    tried: list[_Try] = []
    refused: list[DisagreementError] = []
    lenses = _lenses(known)
    for camera in lenses:
        try:
            tried.append(_joined_by(camera, tracked, known, config.solver, encoder))
        except DisagreementError as error:
            refused.append(error)
    if not tried:
        raise DisagreementError(f"{refused[0]}{_of_lenses(lenses)}") from refused[0]
    best = min(tried, key=lambda one: one.dearer)
    runs, belief = best.runs, best.belief
    settled = [
        replace(run, similarity=_settled(belief.known, own.known, similarity))
        for run, own, similarity in zip(runs, best.beliefs, best.similarities, strict=True)
    ]
    first, last = runs[0].kept.session, max(record.index for run in runs for record in run.records)
    first_pose, presented, _, anew = first["steering"]
    state = {
        **first,
        "solver": belief,
        "camera": belief.camera,
        "steering": (first_pose, Presented(presented.first), last, anew),
    }
    return Whole(settled, state, belief.camera, [_told(joint) for joint in best.joints], best.dearer)


@dataclass(frozen=True, eq=False)
class _Try:
    """The parts joined by one lens; runs and beliefs are those that it makes of them."""

    runs: Sequence[PartRun]
    beliefs: Sequence[Belief]
    joints: Sequence[Joint]
    similarities: Sequence[Similarity]
    belief: Belief
    dearer: float


def _lenses(beliefs: Sequence[Belief]) -> list[Camera]:
    """The cameras of the parts, those that are about the same once: where nobody gave the lens, each solved its own."""
    lenses: list[Camera] = []
    for belief in beliefs:
        if all(abs(math.log(belief.camera.fy / other.fy)) > _SAME_LENS for other in lenses):
            lenses.append(belief.camera)
    return lenses


def _of_lenses(lenses: Sequence[Camera]) -> str:
    """What is to be said of lenses that differ: parts that are told one have the better chance to agree."""
    if len(lenses) < 2:
        return ""
    degrees = sorted(one.fov for one in lenses)
    return (
        f"; each part solved the lens anew (vertical fields of view of {degrees[0]:.0f} to {degrees[-1]:.0f} degrees), "
        "so that saying what it is (--fov or --intrinsics) may mend that"
    )


def _joined_by(
    camera: Camera,
    runs: Sequence[PartRun],
    beliefs: Sequence[Belief],
    config: OnlineConfig,
    encoder: FeatureEncoder,
) -> _Try:
    seen = [by_lens(belief, run.records, camera) for belief, run in zip(beliefs, runs, strict=True)]
    by_it = [belief for belief, _ in seen]
    own = [replace(run, records=records) for run, (_, records) in zip(runs, seen, strict=True)]
    joints = [
        _joint(number, by_it[number - 1 : number + 1], own[number - 1 : number + 1])
        for number in range(1, len(own))
    ]
    similarities = [Similarity.identity()]
    for joint in joints:
        similarities.append(similarities[-1].after(joint.fit.similarity))
    belief, dearer = join_beliefs(by_it, similarities, config, encoder, beliefs)
    return _Try(own, by_it, joints, similarities, belief, dearer)


def join_beliefs(
    beliefs: Sequence[Belief],
    similarities: Sequence[Similarity],
    config: OnlineConfig,
    encoder: FeatureEncoder,
    before: Sequence[Belief] | None = None,
) -> tuple[Belief, float]:
    """What the parts know as one, and how many times as much their keyframes cost so; see `map_joining.joined`.

    Args:
        beliefs: Of the parts, all by one lens.
        similarities: From each part's object to the first one's.
        config: Of the solver.
        encoder: Of the features.
        before: The parts as they were solved, each by its own lens, which tell what they cost by themselves.

    Raises:
        DisagreementError: If together they explain what was seen far worse than each by itself.
    """
    own = float(np.mean([keyframe_cost(belief.known) for belief in before or beliefs]))
    belief = merge_states(beliefs, similarities, config, encoder)
    together = keyframe_cost(belief.known)
    if together > MOST_DEARER * own:
        raise DisagreementError(
            f"one object explains what they show {together / own:.1f} times as badly as one each does"
        )
    return belief, together / own


def _read(
    session: Session, config: PipelineConfig, plan: Plan, folder: Path
) -> tuple[list[PartRun], list[Belief]]:
    """The parts with what each knows, by its own lens."""
    runs: list[PartRun] = []
    beliefs: list[Belief] = []
    for part in plan.parts:
        own = part_folder(folder, part)
        kept = Checkpoint(own, session.state_classes, config.runtime.device).read()
        belief = kept.session["solver"]
        if belief.waiting is not None:
            why = belief.waits_for or "the object did not move enough in it"
            raise DisagreementError(f"the shape was never told in part {part.number + 1} ({why})")
        records = RunReader(own, refined=False).frames
        beliefs.append(belief)
        runs.append(PartRun(part, own, kept, records, Similarity.identity()))
    return runs, beliefs


def _joint(number: int, beliefs: Sequence[Belief], runs: Sequence[PartRun]) -> Joint:
    try:
        return joint_of(beliefs[0], beliefs[1], runs[0].records, runs[1].records)
    except DisagreementError as error:
        raise DisagreementError(f"parts {number} and {number + 1}: {error}") from error


def _settled(known: ObjectMap, own: ObjectMap, similarity: Similarity) -> Similarity:
    """How a part lies in the joined object after the refinement moved its keyframes."""
    after = {view.index: view.pose for view in known.keyframes}
    before = {view.index: view.pose for view in moved(own, similarity).keyframes}
    common = sorted(before.keys() & after.keys())
    if len(common) < _FEWEST_KEYFRAMES:
        return similarity
    poses = []
    for side in (after, before):
        T = np.tile(np.eye(4), (len(common), 1, 1))
        for n, index in enumerate(common):
            T[n, :3, :3], T[n, :3, 3] = pose_arrays(side[index])
        poses.append(T)
    fit = fit_similarity(poses[0], poses[1], own_points(known), own_points(known))
    return fit.similarity.after(similarity)


def own_points(known: ObjectMap) -> np.ndarray:
    """``(V, 3)`` vertices of a map: what holds a small change of coordinates to where the object is."""
    return np.asarray(known.vertices.double().cpu().numpy())


def _told(joint: Joint) -> dict[str, Any]:
    fit = joint.fit
    return {
        "frames": joint.frames,
        "landmarks": joint.landmarks,
        "degrees": float(np.median(fit.angles)),
        "distance": float(np.median(fit.distances)),
        "scale": fit.similarity.scale,
        "scale_error": fit.scale_error,
    }
