"""All scores of one method's estimates for one clip.

Every frame of the clip counts, or every frame that the method was asked for. A frame that it skipped or never came to
counts as wrong: IoU 0, rotation 180 degrees, every pose threshold missed.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.runtime.stage_times import STAGES, StageTimes
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.clip import read_truth
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.bop import model_diameter
from tracking3d_bench.evaluation.confidence_scores import ConfidenceScores, score_confidence
from tracking3d_bench.evaluation.mask_scores import MaskScores, compare_masks, score_masks
from tracking3d_bench.evaluation.model_scores import ModelScores, score_model
from tracking3d_bench.evaluation.point_tracks import PointTrackScores, score_points
from tracking3d_bench.evaluation.pose_scores import (
    PoseScores,
    fit_alignment,
    pair_poses,
    rotation_errors,
    score_poses,
)


@dataclass(frozen=True, kw_only=True)
class Scores(MaskScores, PoseScores, PointTrackScores, ModelScores, ConfidenceScores):
    """Scores of estimates; `dataclasses.asdict` gives the JSON of ``tracking3d evaluate``.

    Attributes:
        frames: Number of frames of the clip that the method was asked for.
        frames_missing: How many of them it has no estimate for.
        frames_lost: How many of them it called lost.
        share_lost: Share of `frames` that it called lost or has no estimate for.
        seconds_per_frame, seconds_per_frame_median: Mean and median wall time of a frame; None if it was not
            recorded.
        seconds_decode, seconds_track, seconds_encode, seconds_solve, seconds_map, seconds_write: Mean wall time of each
            stage of a frame, see `tracking3d.runtime.stage_times.StageTimes`; None if it was not recorded.
        peak_memory_mb: Most memory held, in 10^6 bytes; None if it was not recorded.
        memory_growth_mb: How much more was held at most in the second half of the frames than in the first.
        share_tracked: Share of `frames` that it called tracked; None if it does not say so.
    """

    frames: int
    frames_missing: int
    frames_lost: int
    share_lost: float
    seconds_per_frame: float | None
    seconds_per_frame_median: float | None
    peak_memory_mb: float | None
    memory_growth_mb: float | None
    seconds_decode: float | None = None
    seconds_track: float | None = None
    seconds_encode: float | None = None
    seconds_solve: float | None = None
    seconds_map: float | None = None
    seconds_write: float | None = None
    share_tracked: float | None = None


def score(answers: Answers, truth: Truth) -> Scores:
    """Score estimates against ground truth, by every measure for which both sides have data.

    Raises:
        InputError: If a file that one side names cannot be read, or a mask has not the size of the true one.
    """
    mesh = truth.mesh.read() if truth.mesh is not None and answers.T_cam_obj is not None else None
    diameter = None if mesh is None else model_diameter(mesh.vertices)
    pairs = pair_poses(answers, truth)
    alignment = fit_alignment(pairs, diameter)
    rotation = {} if pairs is None else rotation_errors(pairs)
    masks = compare_masks(answers, truth)
    seconds = list(answers.seconds.values())
    missing = set(answers.asked) - answers.answered
    return Scores(
        **asdict(score_masks(masks, answers, truth)),
        **asdict(score_poses(answers, pairs, alignment)),
        **asdict(score_points(answers, truth)),
        **asdict(score_model(answers, truth, pairs, alignment, mesh, diameter)),
        **asdict(score_confidence(answers, rotation, masks)),
        frames=len(answers.asked),
        frames_missing=len(missing),
        frames_lost=len(answers.lost),
        share_lost=len(missing | answers.lost) / len(answers.asked),
        seconds_per_frame=float(np.mean(seconds)) if seconds else None,
        seconds_per_frame_median=float(np.median(seconds)) if seconds else None,
        peak_memory_mb=answers.peak_memory_mb,
        memory_growth_mb=answers.memory_growth_mb,
        **_stages(answers),
        share_tracked=None if answers.tracked is None else len(answers.tracked) / len(answers.asked),
    )


def score_mesh(answers: Answers, truth: Truth) -> ModelScores:
    """The scores of the shape alone, and of poses by the true mesh; empty if there is none.

    Raises:
        InputError: If a file that one side names cannot be read.
    """
    mesh = truth.mesh.read() if truth.mesh is not None else None
    diameter = None if mesh is None else model_diameter(mesh.vertices)
    pairs = pair_poses(answers, truth)
    return score_model(answers, truth, pairs, fit_alignment(pairs, diameter), mesh, diameter)


def _stages(answers: Answers) -> dict[str, Any]:
    stages = list(answers.stages.values())
    if not stages or len(stages) < len(answers.seconds):
        return {}
    mean = sum(stages, StageTimes()) * (1 / len(stages))
    return {f"seconds_{stage}": getattr(mean, stage) for stage in STAGES}


def score_run(run_folder: Path, clip: Path, *, refined: bool = True) -> Scores:
    """Score a run folder against a clip in our own layout, see `tracking3d_bench.datasets.clip`.

    Args:
        run_folder: The run.
        clip: The clip that it was made on.
        refined: See `answers_of_run`.

    Raises:
        InputError: If either folder is not what it should be, they have no frame in common, or a mask has not
            the size of the true one.
    """
    truth = read_truth(clip)
    return score(answers_of_run(run_folder, truth, refined=refined), truth)
