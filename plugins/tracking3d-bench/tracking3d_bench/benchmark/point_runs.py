"""Accuracy of point tracks through finished runs, compared with methods without a model."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.points.follow import FEATURES, follow_points
from tracking3d.results.point_tracking import open_scene
from tracking3d.results.run_reader import RunReader, is_finished
from tracking3d.video.image_file import read_image
from tracking3d.video.image_sequence import ImageSequence
from tracking3d_bench.benchmark.job import JOB, RUN, Job
from tracking3d_bench.benchmark.point_methods import PointMethod, chained_dense_flow, chained_lucas_kanade
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.evaluation.tapvid import THRESHOLDS, first_queries, tapvid_scores, to_tapvid_raster

LONG = 10
"""Frames that a point was hidden for, from which its return counts by itself."""
METHODS = ("corrected", "mesh alone", "Lucas-Kanade", "dense flow")


@dataclass(frozen=True)
class PointRow:
    """One method on one run; a share of nothing is None.

    Attributes:
        delta, occlusion, jaccard: TAP-Vid's delta_avg, OA and AJ of query mode ``first``.
        returned: delta_avg in the frames in which a point is seen after it was hidden for `LONG` frames or more.
    """

    delta: float | None
    occlusion: float | None
    jaccard: float | None
    returned: float | None


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Points of one run in all frames after their query in which they are truly visible and have a position."""

    error: NDArray[np.float64]  # (M,) pixels of the frame
    uncertainty: NDArray[np.float64]  # (M,)
    measured: NDArray[np.bool_]  # (M,) bool
    features: NDArray[np.float64]  # (M, F), see `tracking3d.points.follow.error_features`


@dataclass(frozen=True, eq=False)
class MeasuredRun:
    """What came of one run."""

    sequence: str  # its sequence
    masks: str  # the source of its initial masks
    refined: bool  # whether its refined estimates were taken
    rows: dict[str, PointRow]  # by method
    inside: float | None  # share of the errors inside twice the uncertainty
    errors: PointErrors  # errors of the corrected points
    seconds_landmarks: float  # for opening the frames and finding landmarks, once a run


def finished_jobs(folder: Path) -> list[tuple[Job, Path]]:
    """The finished runs that ``evaluate suite --out FOLDER`` left, of sequences with true points, and their folders.

    Raises:
        InputError: If there is none.
    """
    jobs = []
    for file in sorted(folder.rglob(JOB)):
        try:
            job = Job.read(file)
            if (
                is_finished(file.parent / RUN)
                and job.truth.points is not None
                and job.truth.symmetry_axis is None
            ):
                jobs.append((job, file.parent / RUN))
        except (KeyError, json.JSONDecodeError) as error:
            raise InputError(f"{file} is damaged ({error}); remove its folder.") from error
    if not jobs:
        raise InputError(
            f"{folder} holds no finished run of a sequence with true points; give the --out of `evaluate suite`."
        )
    return jobs


def measure_run(job: Job, folder: Path, refined: bool = True, beside: bool = False) -> MeasuredRun:
    """Query every true point in the frame that first shows it, and score the later positions.

    Args:
        job: A finished job.
        folder: Its run folder.
        refined: Take the refined estimates, else the causal ones.
        beside: Score the other methods too.

    Raises:
        InputError: If the run or its sequence cannot be read.
    """
    truth = job.truth
    assert truth.points is not None
    tracks, visible = truth.points.positions.transpose(1, 0, 2), truth.points.visible.T
    queries, point = first_queries(~visible, tracks)
    tracks, visible = tracks[point], visible[point]
    after = np.arange(tracks.shape[1]) > queries[:, :1]
    start = time.perf_counter()
    run = RunReader(folder, refined)
    source = ImageSequence(job.sequence, truth.frames, range(len(truth.frames)))
    scene = open_scene(run, source)
    seconds = time.perf_counter() - start

    per_frame: list[PointErrors] = []

    def corrected(frame: int, xy: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        rows = [row for row, one in enumerate(run.frames) if one.index == frame]
        positions, seen = (
            np.full((tracks.shape[1], len(xy), 2), np.nan),
            np.zeros((tracks.shape[1], len(xy)), bool),
        )
        if not rows:
            return positions, seen
        found = follow_points(scene.scene, rows[0], xy)
        indices = [one.index for one in run.frames]
        positions[indices], seen[indices] = found.positions, found.visible
        mine = np.flatnonzero(queries[:, 0] == frame)
        truly = (visible & after)[mine][:, indices].T & np.isfinite(found.uncertainty)
        error = np.linalg.norm(found.positions - tracks[mine][:, indices].transpose(1, 0, 2), axis=2)
        per_frame.append(
            PointErrors(error[truly], found.uncertainty[truly], found.measured[truly], found.features[truly])
        )
        return positions, seen

    methods: dict[str, PointMethod] = {METHODS[0]: corrected}
    if beside:
        methods |= _others(job, folder, refined)
    rows = {
        name: _score(method, queries, tracks, visible, after, _size(job)) for name, method in methods.items()
    }
    errors = _together(per_frame)
    inside = float(np.mean(errors.error <= 2 * errors.uncertainty)) if len(errors.error) else None
    return MeasuredRun(job.sequence, job.variant.masks, refined, rows, inside, errors, seconds)


def _together(parts: list[PointErrors]) -> PointErrors:
    if not parts:
        return PointErrors(np.zeros(0), np.zeros(0), np.zeros(0, bool), np.zeros((0, FEATURES)))
    return PointErrors(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("error", "uncertainty", "measured", "features")
        )
    )


def _size(job: Job) -> tuple[int, int]:
    height, width = read_image(job.truth.frames[0]).shape[:2]
    return width, height


def _others(job: Job, folder: Path, refined: bool) -> dict[str, PointMethod]:
    frames = [cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY) for path in job.truth.frames]
    by_mesh = answers_of_run(folder, job.truth, refined=refined).points
    assert by_mesh is not None
    others = (by_mesh, chained_lucas_kanade(frames), chained_dense_flow(frames))
    return dict(zip(METHODS[1:], others, strict=True))


def _score(
    method: PointMethod,
    queries: NDArray[np.float64],
    tracks: NDArray[np.float64],
    visible: NDArray[np.bool_],
    after: NDArray[np.bool_],
    size: tuple[int, int],
) -> PointRow:
    found, seen = np.full(tracks.shape, np.nan), np.zeros(visible.shape, bool)
    for frame in np.unique(queries[:, 0]).astype(int):
        mine = np.flatnonzero(queries[:, 0] == frame)
        positions, sees = method(int(frame), queries[mine][:, :0:-1])
        found[mine], seen[mine] = positions.transpose(1, 0, 2), sees.T
    true, said = to_tapvid_raster(tracks, size), to_tapvid_raster(found, size)
    scores = tapvid_scores(queries, ~visible, true, ~seen, said, "first")
    back = returns(visible) & after
    with np.errstate(invalid="ignore"):
        error = np.linalg.norm(said - true, axis=2)[back]
        within = [float(np.mean(error < threshold)) for threshold in THRESHOLDS] if len(error) else []
    returned = sum(within) / len(within) if within else None
    return PointRow(scores.average_within, scores.occlusion_accuracy, scores.average_jaccard, returned)


def returns(visible: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(N, T)`` whether a point is seen after it was hidden for `LONG` frames or more in a row.

    It counts from its return to when it is next hidden for as long.

    Args:
        visible: ``(N, T)``.
    """
    back = np.zeros_like(visible)
    for row, seen in enumerate(visible):
        hidden, been, counts = 0, False, False
        for frame, now in enumerate(seen):
            if now:
                counts |= been and hidden >= LONG
                back[row, frame], hidden, been = counts, 0, True
            else:
                hidden += 1
    return back
