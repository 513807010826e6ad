"""Differences between runs of one video: settings, masks, poses, statuses, times.

One run is what the others are held against; none of them is the truth.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.frames import mask_iou_or_none
from tracking3d.geometry.alignment import align_object_frame
from tracking3d.results.files import read_mask
from tracking3d.results.records import jsonable
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.progress import report_each
from tracking3d.runtime.stage_times import STAGES
from tracking3d.ui.report.figures import angles_between, reliable_poses, stage_times, status_counts

MOST_FRAMES = 6
"""Frames that differ most, which are shown."""


@dataclass(frozen=True, eq=False)
class Difference:
    """One run against the first one, over the ``N`` frames with estimates in both."""

    name: str  # the run
    indices: NDArray[np.int64]  # (N,) of the frames in the source
    iou: NDArray[np.float64]  # (N,) of both masks; NaN where one is missing or both are empty
    rotation: NDArray[np.float64]  # (N,) degrees between both poses; NaN where one is lost
    # (N,) between both, in percent of the object's distance in the first run; NaN likewise
    translation: NDArray[np.float64]
    scale: float  # length of the run's unit in that of the first one's; NaN where no frame has both poses

    @property
    def summary(self) -> dict[str, float | None]:
        """Mean, median and worst of each; None if there is none."""
        return {
            "frames": len(self.indices),
            "iou_mean": _figure(np.mean, self.iou),
            "iou_least": _figure(np.min, self.iou),
            "rotation_median_deg": _figure(np.median, self.rotation),
            "rotation_greatest_deg": _figure(np.max, self.rotation),
            "translation_median_percent": _figure(np.median, self.translation),
            "translation_greatest_percent": _figure(np.max, self.translation),
            "scale": self.scale if np.isfinite(self.scale) else None,
        }


@dataclass(frozen=True, eq=False)
class RunComparison:
    """Runs over one video."""

    runs: list[RunReader]  # the runs; the first one is what the others are held against
    names: list[str]  # what to call them; no two alike
    # by name, the value in each run as text, of those that differ; None if a run has none such
    settings: dict[str, list[str | None]]
    differences: list[Difference]  # differences of each run but the first
    worst: list[int]  # indices of the frames that differ most, in order of time
    notes: list[str]  # what to know, in sentences
    iou_between: NDArray[np.float64]  # (R, R) mean IoU of the masks of every two runs; NaN if there is none
    rotation_between: NDArray[np.float64]  # (R, R) degrees between their poses, in the median; NaN likewise

    def as_json(self) -> dict[str, Any]:
        """All of it in JSON's types, frame by frame too."""
        summary: dict[str, Any] = jsonable(
            {
                "runs": [
                    {"name": name, "folder": run.folder, "state": run.state, **run_figures(run)}
                    for name, run in zip(self.names, self.runs, strict=True)
                ],
                "settings": self.settings,
                "differences": [
                    {
                        "run": one.name,
                        "against": self.names[0],
                        **one.summary,
                        "by_frame": {
                            "index": one.indices,
                            "iou": one.iou,
                            "rotation_deg": one.rotation,
                            "translation_percent": one.translation,
                        },
                    }
                    for one in self.differences
                ],
                "worst_frames": self.worst,
                "every_pair": [
                    {
                        "runs": [self.names[row], self.names[column]],
                        "iou_mean": _finite_or_none(self.iou_between[row, column]),
                        "rotation_median_deg": _finite_or_none(self.rotation_between[row, column]),
                    }
                    for row, column in combinations(range(len(self.runs)), 2)
                ],
                "notes": self.notes,
            }
        )
        return summary


def compare_runs(folders: Sequence[Path], against: Path | None = None) -> RunComparison:
    """Hold runs against one of them, and every two against each other.

    Poses are compared after the similarity that fits best, since object frame and unit of a run are its own.

    Args:
        folders: Two run folders or more; one is enough if ``against`` is another.
        against: The run that the others are held against, among them or not; the first if None.

    Raises:
        InputError: If one is no run folder, or damaged; if there are fewer than two; if they are of different videos,
            as far as their sizes and frames tell.
    """
    if against is not None:
        folders = [against, *(folder for folder in folders if folder.resolve() != against.resolve())]
    if len(folders) < 2:
        raise InputError("A comparison needs two run folders or more.")
    runs = [RunReader(folder) for folder in folders]
    first, *others = runs
    for other in others:
        _check_same_video(first, other)
    names = _names([run.folder for run in runs])
    differences = [_difference(name, first, other) for name, other in zip(names[1:], others, strict=True)]
    iou, rotation = _between(runs, differences)
    configs = [flat(run.config) for run in runs]
    keys = dict.fromkeys(key for config in configs for key in config)
    values = {key: [config.get(key) for config in configs] for key in keys}
    values["selected frames"] = [run.description.get("selection") or "all" for run in runs]
    return RunComparison(
        runs=runs,
        names=names,
        settings={key: each for key, each in values.items() if len(set(each)) > 1},
        differences=differences,
        worst=worst_frames(differences),
        notes=_notes(runs, names, differences),
        iou_between=iou,
        rotation_between=rotation,
    )


def run_figures(run: RunReader) -> dict[str, Any]:
    """Statuses and time of one run; seconds are those of a frame, its share of the final refinement included."""
    causal, refined = stage_times(run)
    stages = None if causal is None else (causal + refined) * (1 / len(run.frames))
    return {
        "frames": len(run.frames),
        **status_counts(run.frames),
        "seconds_per_frame": None if stages is None else stages.whole,
        "stages": None if stages is None else {stage: getattr(stages, stage) for stage in STAGES},
    }


def worst_frames(differences: Sequence[Difference], most: int = MOST_FRAMES) -> list[int]:
    """Indices of the frames that differ most, in order of time: two thirds by masks, the others by rotation.

    They keep some distance, since what goes wrong in one frame does so in its neighbours.
    """
    chosen: list[int] = []
    by_mask: dict[int, float] = {}
    by_turn: dict[int, float] = {}
    for one in differences:
        for index, iou, turn in zip(one.indices.tolist(), one.iou, one.rotation, strict=True):
            by_mask[index] = max(by_mask.get(index, 0.0), 1 - np.nan_to_num(iou, nan=1.0))
            by_turn[index] = max(by_turn.get(index, 0.0), np.nan_to_num(turn))
    apart = max(len(by_mask) // (2 * most), 1)
    for found, until in ((by_mask, most - most // 3), (by_turn, most)):
        for index in sorted(found, key=lambda index: -found[index]):
            if len(chosen) >= until or not found[index] > 0:
                break
            if all(abs(index - other) >= apart for other in chosen):
                chosen.append(index)
    return sorted(chosen)


def _difference(name: str, first: RunReader, other: RunReader) -> Difference:
    records = {record.index: record for record in first.frames}
    shared = [record.index for record in other.frames if record.index in records]
    others = {record.index: record for record in other.frames}
    T_first = reliable_poses([records[index] for index in shared])
    T_other = reliable_poses([others[index] for index in shared])
    rotation, translation, scale = _pose_differences(T_first, T_other)
    return Difference(
        name=name,
        indices=np.array(shared, dtype=np.int64),
        iou=np.array(
            [_iou(first, other, index) for index in report_each("comparing masks", shared)], dtype=np.float64
        ),
        rotation=rotation,
        translation=translation,
        scale=scale,
    )


def _between(
    runs: list[RunReader], differences: list[Difference]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean IoU and median rotation of every two runs, ``(R, R)`` each; ``differences`` are those from the first."""
    iou, rotation = np.ones((len(runs), len(runs))), np.zeros((len(runs), len(runs)))
    for row, column in combinations(range(len(runs)), 2):
        one = differences[column - 1] if not row else _difference("", runs[row], runs[column])
        for table, figure in ((iou, one.summary["iou_mean"]), (rotation, one.summary["rotation_median_deg"])):
            table[row, column] = table[column, row] = np.nan if figure is None else figure
    return iou, rotation


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _iou(first: RunReader, other: RunReader, index: int) -> float:
    a, b = read_mask(first.mask_path(index)), read_mask(other.mask_path(index))
    if a is None or b is None or a.shape != b.shape:
        return np.nan
    iou = mask_iou_or_none(a, b)
    return np.nan if iou is None else iou


def _pose_differences(
    T_first: NDArray[np.float64], T_other: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Degrees, percent of the distance, and the scale between them; NaN where a pose is missing."""
    rotation, translation = np.full(len(T_first), np.nan), np.full(len(T_first), np.nan)
    both = np.isfinite(T_first).all((1, 2)) & np.isfinite(T_other).all((1, 2))
    if not both.any():
        return rotation, translation, np.nan
    alignment = align_object_frame(T_other[both], T_first[both])
    aligned = alignment.poses(T_other[both])
    rotation[both] = angles_between(aligned[:, :3, :3], T_first[both, :3, :3])
    away = np.linalg.norm(T_first[both, :3, 3], axis=1)
    apart = np.linalg.norm(aligned[:, :3, 3] - T_first[both, :3, 3], axis=1)
    translation[both] = 100 * apart / np.maximum(away, 1e-12)
    return rotation, translation, alignment.scale


def _check_same_video(first: RunReader, other: RunReader) -> None:
    """Refuse what cannot be of one video.

    Raises:
        InputError: Says in what they differ.
    """
    sizes = [f"{run.camera.width} x {run.camera.height}" for run in (first, other)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"Frames of {first.folder} have {sizes[0]} pixels and those of {other.folder} have {sizes[1]}; "
            "compare runs of one video."
        )
    if not {record.index for record in first.frames} & {record.index for record in other.frames}:
        raise InputError(
            f"{first.folder} and {other.folder} have estimates for no common frame; compare runs of the same "
            "frames."
        )


def _notes(runs: list[RunReader], names: list[str], differences: list[Difference]) -> list[str]:
    notes = [
        f"{name} is {run.state_in_words}: {len(run.frames)} frames have an estimate."
        for name, run in zip(names, runs, strict=True)
        if run.state != "finished"
    ]
    first = runs[0]
    for name, run, one in zip(names[1:], runs[1:], differences, strict=True):
        if len(one.indices) < max(len(first.frames), len(run.frames)):
            notes.append(
                f"{names[0]} has estimates for {len(first.frames)} frames and {name} for {len(run.frames)}; "
                f"they are compared in the {len(one.indices)} frames that both have."
            )
        prompts = [
            prompt if isinstance(prompt := each.description.get("prompt"), dict) else {}
            for each in (first, run)
        ]
        (start, other_start), (crc, other_crc) = (
            [prompt.get(key) for prompt in prompts] for key in ("first_frame", "first_image_crc")
        )
        if start == other_start and None not in (crc, other_crc) and crc != other_crc:
            notes.append(
                f"The first images of {names[0]} and {name} differ; make sure that both runs are of one video."
            )
        if abs(first.camera.fx - run.camera.fx) > 1e-3 * first.camera.fx:
            notes.append(
                f"{names[0]} and {name} use different focal lengths ({first.camera.fx:.0f} and "
                f"{run.camera.fx:.0f} pixels), which alone makes their poses differ."
            )
        if not np.isfinite(one.rotation).any():
            notes.append(f"No frame has a pose in both {names[0]} and {name}.")
    return notes


def _names(folders: list[Path]) -> list[str]:
    """The folder names if they differ, else the full paths; a run that is given twice is numbered."""
    short = [folder.resolve().name for folder in folders]
    names = short if len(set(short)) == len(short) else [str(folder) for folder in folders]
    if len(set(names)) < len(names):
        names = [f"{name} ({number})" for number, name in enumerate(names, 1)]
    return names


def _figure(kind: Any, values: NDArray[np.float64]) -> float | None:
    known = values[np.isfinite(values)]
    return float(kind(known)) if len(known) else None


@dataclass(frozen=True)
class Setting:
    """One setting."""

    name: str  # with its section, such as solver.local_window
    value: str  # as text
    # the value of preset default, if that is another one; None if it is the same or unknown
    usual: str | None


def settings_of(config: Mapping[str, Any]) -> list[Setting]:
    """Every setting of a run, next to its default.

    Args:
        config: The configuration as ``run.json`` holds it.
    """
    usual = flat(load_config().model_dump(mode="json"))
    return [
        Setting(name, value, usual[name] if usual.get(name, value) != value else None)
        for name, value in flat(config).items()
    ]


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Names with their sections, and values as text."""
    found: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value)
    return found
