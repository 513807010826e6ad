"""One run against the truth of its clip: what ``tracking3d evaluate`` reports.

Every frame of the clip counts, or every frame that the run was asked for. A frame that the run skipped or
never came to counts as wrong: IoU 0, rotation 180 degrees.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from tracking3d.datasets.clip import Truth, is_rigid, read_truth
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.evaluation.metrics import (
    aligned_rotation_errors,
    anchored_rotation_errors,
    consecutive_rotation_errors,
    mask_iou,
    share_under,
)
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.video.selection import parse_selection, within

NO_ESTIMATE = 180.0
"""Rotation error in degrees of a frame without an estimate."""


@dataclass(frozen=True, kw_only=True)
class MaskScores:
    """Masks over the frames with a true mask, except the run's first, whose mask was given.

    All are None where there is no such frame.

    Attributes:
        iou_initial_mean: Mean IoU of the mask tracker's masks; 0 where it gave none.
        iou_mean: Mean IoU of the answers.
        iou_gain_percent: How much larger `iou_mean` is than `iou_initial_mean`.
        share_worse_than_initial: Share of frames where the answer's IoU is the smaller one by more than 1e-9.
        frames_with_mask: Number of these frames.
    """

    iou_initial_mean: float | None = None
    iou_mean: float | None = None
    iou_gain_percent: float | None = None
    share_worse_than_initial: float | None = None
    frames_with_mask: int = 0


@dataclass(frozen=True, kw_only=True)
class RotationScores:
    """Rotations over the frames with a trusted pose, in degrees; see `tracking3d.evaluation.metrics`.

    All are None where there is no such frame.

    Attributes:
        rotation_error_mean_deg, rotation_error_median_deg, rotation_error_max_deg: Aligned by one rotation.
        rotation_error_anchored_median_deg: Anchored at the first of these frames that has an estimate.
        rotation_error_consecutive_median_deg: From each to the next, where both have an estimate.
        share_under_5_deg: Share with an aligned error under 5 degrees; a lost frame counts as not.
        frames_with_pose: Number of these frames.
    """

    rotation_error_mean_deg: float | None = None
    rotation_error_median_deg: float | None = None
    rotation_error_max_deg: float | None = None
    rotation_error_anchored_median_deg: float | None = None
    rotation_error_consecutive_median_deg: float | None = None
    share_under_5_deg: float | None = None
    frames_with_pose: int = 0


@dataclass(frozen=True, kw_only=True)
class Scores(MaskScores, RotationScores):
    """What a run is worth; `dataclasses.asdict` gives the JSON of ``tracking3d evaluate``.

    Attributes:
        frames: Number of frames of the clip that the run was asked for.
        frames_missing: How many of them the run has no answer for.
        frames_lost: How many of them it called lost.
        seconds_per_frame: Mean wall time of a frame; None where it was not recorded.
    """

    frames: int
    frames_missing: int
    frames_lost: int
    seconds_per_frame: float | None


def score_run(run_folder: Path, clip: Path) -> Scores:
    """Score a run folder against a clip in the layout of `tracking3d.datasets.clip`.

    A run's frame index is the position of the frame in the clip. If ``run.json`` holds a ``selection``
    ``START:STOP:STEP``, only those frames count.

    Raises:
        InputError: If either folder is not what it should be, they have no frame in common, or a mask has not
            the size of the true one.
    """
    run, truth = RunReader(run_folder), read_truth(clip)
    selection = run.description.get("selection")
    wanted = within(parse_selection(selection and str(selection)), len(truth.names))
    records = {record.index: record for record in run.frames if record.index in wanted}
    if not records:
        raise InputError(
            f"The run {run_folder} has no frame of the clip {clip}; give the clip that this run was made on."
        )
    seconds = [record.seconds for record in records.values() if math.isfinite(record.seconds)]
    return Scores(
        **asdict(_score_masks(run, truth, wanted, records)),
        **asdict(_score_rotations(truth, wanted, records)),
        frames=len(wanted),
        frames_missing=len(wanted) - len(records),
        frames_lost=sum(record.status is Status.LOST for record in records.values()),
        seconds_per_frame=float(np.mean(seconds)) if seconds else None,
    )


def format_scores(scores: Scores) -> Table:
    """The figures as a table to print, with what they mean."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column("measure")
    table.add_column("value", justify="right", style="bold")
    for label, value, unit in (
        ("frames", scores.frames, ""),
        ("of them without an answer", scores.frames_missing, ""),
        ("of them called lost", scores.frames_lost, ""),
        ("IoU of the initial masks, mean", scores.iou_initial_mean, ""),
        ("IoU of the answers, mean", scores.iou_mean, ""),
        ("gain over the initial masks", scores.iou_gain_percent, " %"),
        ("worse than the initial mask", _percent(scores.share_worse_than_initial), " %"),
        ("rotation error, mean", scores.rotation_error_mean_deg, "°"),
        ("rotation error, median", scores.rotation_error_median_deg, "°"),
        ("rotation error, largest", scores.rotation_error_max_deg, "°"),
        ("anchored at the first frame, median", scores.rotation_error_anchored_median_deg, "°"),
        ("from frame to frame, median", scores.rotation_error_consecutive_median_deg, "°"),
        ("rotation error under 5°", _percent(scores.share_under_5_deg), " %"),
        ("seconds a frame, mean", scores.seconds_per_frame, " s"),
    ):
        table.add_row(label, _text(value, unit))
    return table


def _score_masks(run: RunReader, truth: Truth, wanted: range, records: dict[int, FrameRecord]) -> MaskScores:
    given = min(records)
    scored = [index for index in wanted if index in truth.masks and index != given]
    if not scored:
        return MaskScores()
    ious = np.array([_ious(run, truth, index, index in records) for index in scored])
    answer, initial = ious.mean(axis=0).tolist()
    return MaskScores(
        iou_initial_mean=initial,
        iou_mean=answer,
        iou_gain_percent=100 * (answer / initial - 1) if initial else None,
        share_worse_than_initial=float(np.mean(ious[:, 0] < ious[:, 1] - 1e-9)),
        frames_with_mask=len(scored),
    )


def _ious(run: RunReader, truth: Truth, index: int, recorded: bool) -> tuple[float, float]:
    """IoU of the answer and of the initial mask in frame ``index``; 0 for what is not there."""
    if not recorded:
        return 0.0, 0.0
    true = truth.mask(index)
    answer, initial = run.mask(index), run.initial_mask(index)
    for mask in (answer, initial):
        if mask is not None and mask.shape != true.shape:
            raise InputError(
                f"Frame {index}: the run's mask is {mask.shape[1]} x {mask.shape[0]} pixels and the true one "
                f"of {truth.folder} {true.shape[1]} x {true.shape[0]}; give the clip this run was made on."
            )
    return mask_iou(answer, true), 0.0 if initial is None else mask_iou(initial, true)


def _score_rotations(truth: Truth, wanted: range, records: dict[int, FrameRecord]) -> RotationScores:
    scored = [index for index in wanted if index in truth.T_cam_obj]
    if not scored:
        return RotationScores()
    found = [n for n, index in enumerate(scored) if index in records and is_rigid(records[index].T_cam_obj)]
    aligned, anchored = np.full((2, len(scored)), NO_ESTIMATE)
    consecutive: NDArray[np.float64] = np.empty(0)
    if found:
        R_est = np.stack([records[scored[n]].T_cam_obj[:3, :3] for n in found])
        R_true = np.stack([truth.T_cam_obj[scored[n]][:3, :3] for n in found])
        aligned[found] = aligned_rotation_errors(R_est, R_true)
        anchored[found] = anchored_rotation_errors(R_est, R_true)
        if len(found) > 1:
            consecutive = consecutive_rotation_errors(R_est, R_true)[np.diff(found) == 1]
    tracked = [index in records and records[index].status is not Status.LOST for index in scored]
    return RotationScores(
        rotation_error_mean_deg=float(aligned.mean()),
        rotation_error_median_deg=float(np.median(aligned)),
        rotation_error_max_deg=float(aligned.max()),
        rotation_error_anchored_median_deg=float(np.median(anchored)),
        rotation_error_consecutive_median_deg=float(np.median(consecutive)) if len(consecutive) else None,
        share_under_5_deg=share_under(np.where(tracked, aligned, NO_ESTIMATE)),
        frames_with_pose=len(scored),
    )


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share


def _text(value: float | int | None, unit: str) -> str:
    if value is None:
        return "unknown"
    return f"{value}{unit}" if isinstance(value, int) else f"{value:.{1 if unit == ' %' else 3}f}{unit}"
