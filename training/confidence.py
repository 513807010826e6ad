"""Fit the confidence on half of the sequences of finished benchmark runs, and test it on the other half.

``python training/confidence.py BENCHMARK ... --evidence silhouette,features,matching`` reads every run in the folders
``--out`` of ``tracking3d evaluate suite``. Evidence are names of losses in ``frames.jsonl``, and ``has_mask``,
``iou_initial``, ``recorded`` (the confidence that the run said itself) and ``recorded_odds`` (the logarithm of its
odds), and of the online solver's runs what its confidence is made of
(`tracking3d.estimation.online.state.confidence.confidence_features`), and of refined answers what landmarks say of them
(`tracking3d.reconstruction.confidence.refined_confidence_features`). Without ``--evidence`` all losses count. A name
with a sign, ``--evidence=-silhouette,+matching``, can only speak against an answer, or for it.

With ``--balance`` every folder is a group. A group counts with the root of its number of frames, so that a long clip
does not decide alone, and the fit on all other groups is tested on each of them.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.state.confidence import confidence_features
from tracking3d.points.landmark_adjustment import LandmarkSupport
from tracking3d.reconstruction.confidence import refined_confidence_features as supported_by
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.logistic_model import LogisticModel
from tracking3d_bench.benchmark.job import JOB, RUN, Job
from tracking3d_bench.datasets.run_answers import answers_of_run
from tracking3d_bench.evaluation.calibration import area_under_roc, expected_calibration_error, reliability
from tracking3d_bench.evaluation.confidence_fit import (
    PENALTY,
    as_logistic_model,
    fit_confidence,
    halves,
)
from tracking3d_bench.evaluation.confidence_scores import frame_difficulties, right_frames
from tracking3d_bench.evaluation.mask_scores import compare_masks
from tracking3d_bench.evaluation.pose_scores import pair_poses, rotation_errors


@dataclass(frozen=True)
class Judged:
    """One frame of a run.

    Attributes:
        sequence: Its sequence.
        group: The folder of the benchmark.
        evidence: What the run knew, by name.
        right: What the truth says.
        difficulty: See `frame_difficulties`.
    """

    sequence: str
    group: str
    evidence: dict[str, float]
    right: bool
    difficulty: float


def judged_frames(benchmark: Path, solver: str | None, refined: bool) -> Iterator[Judged]:
    """Every frame with a known truth of every finished run in a folder of benchmarks."""
    for file in sorted(benchmark.rglob(JOB)):
        run = file.parent / RUN
        if not (run / "run.json").is_file():
            continue
        reader = RunReader(run, refined)
        if reader.state != "finished" or solver not in (None, reader.config["solver"]["name"]):
            continue
        truth = Job.read(file).truth
        answers = answers_of_run(run, truth, refined=refined)
        pairs = pair_poses(answers, truth)
        rotation = {} if pairs is None else rotation_errors(pairs)
        right = right_frames(answers, rotation, compare_masks(answers, truth))
        difficulty = frame_difficulties(truth)
        for record in reader.frames:
            if record.index in right:
                known = record.iou_initial is not None
                evidence = {
                    **record.losses,
                    **record.diagnostics,
                    **_of_tracking(record),
                    "has_mask": float(known),
                    "iou_initial": record.iou_initial if record.iou_initial is not None else np.nan,
                    "recorded": record.confidence,
                    "recorded_odds": _log_odds(record.confidence),
                    **_of_landmarks(record),
                }
                group, hard = benchmark.resolve().name, difficulty.get(record.index, 0.0)
                yield Judged(truth.name, group, evidence, right[record.index], hard)


def _log_odds(probability: float) -> float:
    bounded = min(max(probability, 0.01), 0.99)
    return math.log(bounded / (1 - bounded))


def _of_tracking(record: FrameRecord) -> dict[str, float]:
    """The features of the causal confidence, if the solver records them."""
    known = "inliers" in record.diagnostics
    return confidence_features(record.losses, record.diagnostics) if known else {}


def _of_landmarks(record: FrameRecord) -> dict[str, float]:
    """What landmarks say of a refined answer, beside what was believed before they were asked."""
    if "landmark_matches" not in record.diagnostics or record.status is Status.LOST:
        return {}
    followed, agreeing = (
        int(record.diagnostics["landmark_matches"]),
        int(record.diagnostics["landmark_inliers"]),
    )
    support = LandmarkSupport(followed, agreeing)
    return supported_by(record.diagnostics.get("confidence_before", record.confidence), support)


def table(frames: list[Judged], names: list[str]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Evidence ``(N,)`` by name, NaN where a frame has none, and whether the frames are right ``(N,)``."""
    evidence = {name: np.array([one.evidence.get(name, np.nan) for one in frames]) for name in names}
    return evidence, np.array([one.right for one in frames], dtype=bool)


def balanced(frames: list[Judged]) -> np.ndarray:
    """The weight ``(N,)`` of each frame: one over the root of how many there are in its group."""
    sizes = Counter(one.group for one in frames)
    return np.array([1 / math.sqrt(sizes[one.group]) for one in frames])


def fit_groups(
    frames: list[Judged], names: list[str], signs: dict[str, int], penalty: float
) -> LogisticModel:
    """The fit on all groups; for every group it is printed what a fit on the others is worth there."""
    groups = sorted({one.group for one in frames})
    if len(groups) < 2:
        raise InputError("At least two folders with finished runs are needed for --balance; give more.")
    errors = []
    for group in groups:
        others = [one for one in frames if one.group != group]
        fit = fit_confidence(*table(others, names), signs, penalty, balanced(others))
        held_out = [one for one in frames if one.group == group]
        evidence, right = table(held_out, names)
        recorded = np.array([one.evidence["recorded"] for one in held_out])
        print(f"{group}: {len(right)} frames, {right.mean():.2f} right")
        errors.append(f"{group}: {tested(fit(evidence), held_out)}")
        print(f"  fitted on the others: {errors[-1]}")
        print(f"  recorded:             {tested(recorded, held_out)}")
    fit = fit_confidence(*table(frames, names), signs, penalty, balanced(frames))
    return as_logistic_model(fit, f"{len(frames)} frames of {', '.join(groups)}", "; ".join(errors))


def tested(said: np.ndarray, frames: list[Judged]) -> str:
    """What confidences ``(N,)`` are worth, in words."""
    right = np.array([one.right for one in frames], dtype=bool)
    difficulty = np.array([one.difficulty for one in frames])
    hardest = difficulty >= np.quantile(difficulty, 0.75)
    error, area = expected_calibration_error(said, right), area_under_roc(said, right)
    hard = expected_calibration_error(said[hardest], right[hardest])
    brier = float(np.mean((said - right) ** 2))
    shown = "-" if area is None else f"{area:.3f}"
    return (
        f"calibration error {error:.3f}, of the hardest quarter {hard:.3f}, area under the curve {shown}, "
        f"Brier score {brier:.3f}"
    )


def main(words: list[str]) -> None:
    """Read, fit, test and print."""
    options = _options(words)
    frames = [
        one for folder in options.benchmarks for one in judged_frames(folder, options.solver, options.refined)
    ]
    asked = options.evidence.split(",") if options.evidence else _all_losses(frames)
    names = [name.lstrip("+-") for name in asked]
    # Of refined answers what is lost is not judged by landmarks, and has none of their evidence.
    frames = [one for one in frames if any(name in one.evidence for name in names)]
    signs = {name.lstrip("+-"): 1 if name[0] == "+" else -1 for name in asked if name[:1] in ("+", "-")}
    if options.balance:
        _print(fit_groups(frames, names, signs, options.penalty), options.json)
        return
    first, second = halves([one.sequence for one in frames])
    if not second:
        raise InputError("At least two sequences with finished runs are needed; give other folders.")
    errors = []
    for fitted, other in ((first, second), (second, first)):
        tests = [one for one in frames if one.sequence in other]
        learnt, held_out = (
            table(half, names) for half in ([one for one in frames if one.sequence in fitted], tests)
        )
        evidence, right = held_out
        said = fit_confidence(*learnt, signs, options.penalty)(evidence)
        print(f"fitted on {len(fitted)} sequences, {len(learnt[1])} frames, {learnt[1].mean():.2f} right")
        print(f"tested on {len(other)} sequences, {len(right)} frames, {right.mean():.2f} right")
        errors.append(tested(said, tests))
        print(f"  fitted:   {errors[-1]}")
        recorded = table(tests, ["recorded"])[0]["recorded"]
        if np.isfinite(recorded).all():
            print(f"  recorded: {tested(recorded, tests)}")
        found = reliability(said, right)
        for low, high, count, mean, share in zip(
            found.edges, found.edges[1:], found.count, found.confidence, found.accuracy, strict=False
        ):
            if count:
                print(f"  {low:.1f} to {high:.1f}: {count:5d} frames, said {mean:.2f}, right {share:.2f}")
    everything = fit_confidence(*table(frames, names), signs, options.penalty)
    data = f"{len(frames)} frames of {len(first + second)} sequences"
    _print(as_logistic_model(everything, data, f"of halves: {'; '.join(errors)}"), options.json)


def _print(model: LogisticModel, file: Path | None) -> None:
    """The table as the package reads it, on standard output and into a file."""
    text = json.dumps(asdict(model), indent=1)
    print(f"\n{text}")
    if file is not None:
        file.write_text(f"{text}\n", encoding="utf-8")


def _all_losses(frames: list[Judged]) -> list[str]:
    names = {name for one in frames for name in one.evidence} - {"recorded", "iou_initial"}
    return sorted(names)


def _options(words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("benchmarks", type=Path, nargs="+", help="folders of evaluate suite")
    parser.add_argument("--evidence", help="names with commas between them")
    parser.add_argument("--solver", help="only runs of this solver")
    parser.add_argument("--refined", action="store_true", help="the refined answers, not the causal ones")
    parser.add_argument(
        "--penalty", type=float, default=PENALTY, help="how much small coefficients are liked"
    )
    parser.add_argument("--balance", action="store_true", help="folders are groups that count alike")
    parser.add_argument(
        "--json", type=Path, help="write the table there, as those in tracking3d/runtime/weights"
    )
    return parser.parse_args(words)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except (InputError, ValueError) as error:
        sys.exit(str(error))
