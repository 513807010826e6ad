"""Quantities of a run for its pages: statuses, poses relative to the first one, times by stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import Status
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.stage_times import STAGES, StageTimes

_MEANINGS = {
    "decode": "decoding the frame",
    "track": "mask tracker",
    "encode": "features",
    "solve": "pose",
    "map": "shape and texture",
    "write": "writing masks and pictures",
}


def status_counts(records: Sequence[FrameRecord]) -> dict[str, int]:
    """How many estimates have each status."""
    return {status.value: sum(record.status is status for record in records) for status in Status}


def reliable_poses(records: Sequence[FrameRecord]) -> NDArray[np.float64]:
    """``(N, 4, 4)`` poses; NaN if the object was lost or the pose is invalid."""
    poses = np.full((len(records), 4, 4), np.nan)
    for number, record in enumerate(records):
        if record.status is not Status.LOST and record.has_pose:
            poses[number] = record.T_cam_obj
    return poses


def distances(T_cam_obj: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(N,)`` distances of a point of the object from the camera, over the first one that is known.

    Args:
        T_cam_obj: ``(N, 4, 4)``, NaN if unknown.
        middle: ``(3,)`` the point, in object coordinates.
    """
    away = np.linalg.norm(T_cam_obj[:, :3, :3] @ middle + T_cam_obj[:, :3, 3], axis=1)
    known = away[np.isfinite(away) & (away > 0)]
    return away / known[0] if len(known) else away


def turns(T_cam_obj: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(N,)`` degrees by which the object has turned against the first frame of which that is known."""
    angles = np.full(len(T_cam_obj), np.nan)
    known = np.flatnonzero(np.isfinite(T_cam_obj).all((1, 2)))
    if len(known):
        first = np.broadcast_to(T_cam_obj[known[0], :3, :3], (len(known), 3, 3))
        angles[known] = angles_between(T_cam_obj[known, :3, :3], first)
    return angles


def angles_between(R_a: NDArray[np.float64], R_b: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(N,)`` degrees between ``(N, 3, 3)`` rotations."""
    return np.degrees(Rotation.from_matrix(R_a @ R_b.transpose(0, 2, 1)).magnitude())


@dataclass(frozen=True)
class StageShare:
    """What one stage took of a run."""

    name: str  # the stage
    what: str  # in words
    seconds: float  # frame by frame, over the whole run
    again: float  # in the final refinement
    share: float  # share of the longest stage, in percent: frame by frame
    share_again: float  # the same of the refinement


def stage_shares(run: RunReader) -> list[StageShare]:
    """The stages of a run that took any time, in order; none if they are not known.

    Args:
        run: The run.
    """
    causal, refined = stage_times(run)
    if causal is None:
        return []
    longest = max(getattr(causal + refined, stage) for stage in STAGES)
    if not longest > 0:
        return []
    return [
        StageShare(
            name=stage,
            what=_MEANINGS[stage],
            seconds=getattr(causal, stage),
            again=getattr(refined, stage),
            share=100 * getattr(causal, stage) / longest,
            share_again=100 * getattr(refined, stage) / longest,
        )
        for stage in STAGES
    ]


def stage_times(run: RunReader) -> tuple[StageTimes | None, StageTimes]:
    """What the causal estimates took, stage by stage, and what the final refinement did."""
    return run.causal_stages if run.frames else None, run.refinement_stages or StageTimes()


def corrected_frames(run: RunReader) -> list[int]:
    """Indices of the corrected frames."""
    prompt = run.description.get("prompt")
    listed = prompt.get("corrections") if isinstance(prompt, dict) else None
    indices = (
        [one.get("frame") for one in listed if isinstance(one, dict)] if isinstance(listed, list) else []
    )
    return sorted(index for index in indices if isinstance(index, int))
