"""One sequence run one way, in a worker that reads what it is to do from a file.

What is finished is found again by what it
depends on: the run by configuration, masks, frames and code; its scores by the code that judges, too.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tracking3d.config.models import AUTO, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.pipeline.tracker_selection import choose_tracker
from tracking3d.results.files import write_atomic, writing
from tracking3d.runtime.memory import resident_memory
from tracking3d.video.image_file import read_image
from tracking3d.video.image_sequence import ImageSequence
from tracking3d.video.source import FrameSource
from tracking3d_bench.benchmark.fingerprint import (
    code_fingerprint,
    frames_fingerprint,
    key,
    masks_fingerprint,
    plugin_versions,
)
from tracking3d_bench.benchmark.initial_masks import masks_for
from tracking3d_bench.benchmark.noisy_frames import NoisyFrames
from tracking3d_bench.benchmark.variant import Variant
from tracking3d_bench.datasets.layout import load_layout
from tracking3d_bench.datasets.reading import read_sequence
from tracking3d_bench.datasets.run_answers import answers_of_run, is_refined
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.score import score

if TYPE_CHECKING:
    from tracking3d.pipeline.record import Listener

JOB, SCORES, RUN, LOG, MASKS = "job.json", "scores.json", "run", "log.txt", "initial_masks"
MEMORY = "memory.json"
"""Megabytes held after each frame."""


@dataclass(frozen=True)
class Job:
    """A sequence and how to run it."""

    layout: str  # name of a dataset's layout, or the YAML file of one
    root: Path  # folder of the dataset
    sequence: str  # the sequence's name
    variant: Variant  # how to run it
    out: Path  # the folder for everything of this benchmark

    @cached_property
    def truth(self) -> Truth:
        """What is known about the sequence, with the changes that the variant makes to its input."""
        return self.variant.input.apply(self.unchanged_truth)

    @cached_property
    def unchanged_truth(self) -> Truth:
        """What is known about the sequence as the dataset has it."""
        return read_sequence(load_layout(self.layout), self.root, self.sequence)

    @cached_property
    def config(self) -> PipelineConfig:
        """The pipeline with its mask tracker, and the camera that the dataset gives to one unless there is one."""
        config = self.variant.config
        if self.variant.masks == "tracker" and config.tracker.name == AUTO:
            size = read_image(self.truth.frames[0]).shape[:2]
            config, _ = choose_tracker(config, len(self.truth.frames), False, size)
        camera = self.truth.given_camera or self.truth.camera
        if (
            camera is None
            or not self.truth.camera_told
            or config.camera.intrinsics is not None
            or config.camera.fov is not None
        ):
            return config
        settings = config.camera.model_copy(
            update={"intrinsics": (camera.fx, camera.fy, camera.cx, camera.cy)}
        )
        return config.model_copy(update={"camera": settings})

    @cached_property
    def run_key(self) -> str:
        """What the run depends on."""
        masks, config = self.variant.masks, self.config
        return key(
            plugin_versions(config.tracker.name, config.features.name),
            config.model_dump(mode="json"),
            self.truth.box,
            masks,
            masks_fingerprint(masks, self.sequence),
            frames_fingerprint(self.truth),
            code_fingerprint(judges=False),
            *self.variant.disturbance,
        )

    @cached_property
    def score_key(self) -> str:
        """What the scores depend on."""
        return key(self.run_key, code_fingerprint(judges=True))

    @property
    def folder(self) -> Path:
        """Folder of the run and its scores."""
        return self.out / "runs" / Path(self.layout).stem / self.sequence / self.run_key[:16]

    def finished(self) -> dict[str, Any] | None:
        """The scores of an earlier process, if nothing that they depend on has changed since."""
        scores = _read(self.folder / SCORES)
        return scores["scores"] if scores and scores["key"] == self.score_key else None

    def written(self) -> dict[str, Any] | None:
        """The scores that lie there, whatever they depended on; None if there are none."""
        scores = _read(self.folder / SCORES)
        return scores["scores"] if scores else None

    def write(self) -> Path:
        """Write the job for a process to read; returns the file."""
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        document = {
            "layout": self.layout,
            "root": str(self.root),
            "sequence": self.sequence,
            "variant": self.variant.model_copy(update={"config": self.config}).model_dump(mode="json"),
            "out": str(self.out),
        }
        write_atomic(self.folder / JOB, json.dumps(document, indent=1).encode())
        return self.folder / JOB

    @classmethod
    def read(cls, file: Path) -> Job:
        """Read what `write` wrote."""
        document = json.loads(file.read_bytes())
        document["variant"] = Variant.model_validate(document["variant"])
        return cls(**{**document, "root": Path(document["root"]), "out": Path(document["out"])})


def run_job(job: Job) -> dict[str, Any]:
    """Track, unless the run is there, and score; the scores are written too.

    Those of the final estimates are by name of the measure. If there are refined estimates, ``causal`` holds the
    scores of the causal ones, else None.

    Raises:
        Tracking3dError: If the sequence cannot be read, tracked or scored.
    """
    run = job.folder / RUN
    if (_read(run / "run.json") or {}).get("state") != "finished":
        _track(job, run)
    growth = memory_growth(_read(job.folder / MEMORY) or [])

    def judged(*, refined: bool) -> dict[str, Any]:
        answers = answers_of_run(run, job.truth, refined=refined)
        return asdict(score(replace(answers, memory_growth_mb=growth), job.truth))

    scores = judged(refined=True) | {"causal": judged(refined=False) if is_refined(run) else None}
    write_atomic(job.folder / SCORES, json.dumps({"key": job.score_key, "scores": scores}, indent=1).encode())
    return scores


def memory_growth(held: Sequence[float]) -> float | None:
    """Growth of the peak memory from the first half of the frames to the second; None for fewer than two."""
    half = len(held) // 2
    return max(held[half:]) - max(held[:half]) if half else None


def _track(job: Job, run: Path) -> None:
    held: list[float] = []

    def after_frame(frame: object) -> None:
        # The second pass holds more once, not more and more.
        if not getattr(frame, "refined", False):
            held.append(resident_memory()[0])

    _record(job, run, after_frame)
    write_atomic(job.folder / MEMORY, json.dumps(held).encode())


def _record(job: Job, run: Path, listener: Listener) -> None:
    from tracking3d.pipeline.record import record  # slow to import

    truth, config = job.truth, job.config
    source: FrameSource = ImageSequence(job.sequence, truth.frames, range(len(truth.frames)))
    if job.variant.input.grey_noise is not None:
        source = NoisyFrames(source, job.variant.input.grey_noise)
    if job.variant.masks == "tracker":
        if truth.box is None:
            raise InputError(f"{job.sequence} has no box in its first frame; a mask tracker cannot start.")
        record(source, config, run, box=truth.box_in_frame(), overwrite=True, listener=listener)
        return
    masks = masks_for(job.variant.masks, truth, job.folder / MASKS)
    tracker = {"name": "precomputed", "path": str(masks)}
    config = PipelineConfig.model_validate({**config.model_dump(), "tracker": tracker})
    try:
        record(source, config, run, overwrite=True, listener=listener)
    finally:
        if masks.is_relative_to(job.folder):  # the run has its own copy of them
            shutil.rmtree(masks, ignore_errors=True)


def _read(file: Path) -> Any:
    """What a JSON file holds; None if there is none that can be read."""
    try:
        return json.loads(file.read_bytes())
    except (OSError, ValueError):
        return None
