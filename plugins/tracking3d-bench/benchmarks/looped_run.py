"""Does a long run stay as it is? Memory, open files and seconds a frame over thousands of frames.

The object of a short synthetic clip turns to and fro, and leaves the frame and returns in every round. The whole of
`tracking3d.pipeline.record.record` is run, with everything that it writes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import psutil
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.geometry.camera import Camera
from tracking3d.pipeline.record import record
from tracking3d.results.records import FrameRecord
from tracking3d.runtime.memory import resident_memory
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.video.source import Intrinsics

SETTLED = 500
"""Frames after which nothing may grow any more: compilers and caches are warm, and all keyframes are there."""
MEMORY = 0.05
"""Share by which memory may grow from there to the end, by its trend."""
SPEED = 0.25
"""The same of the seconds a frame; other programs on the machine show in them."""

_TURNING = 60  # frames of a round in which the object turns in sight; it comes back the way it went
_LEAVING = 12  # frames in which it leaves, and as many in which it returns
_ABSENT = 6  # frames without it


@dataclass(frozen=True)
class Sample:
    """One frame of a soak.

    Attributes:
        index: The frame.
        seconds: From the frame before to this one.
        memory: Megabytes of the process.
        descriptors: Open files of the process.
        status: Status of the estimate.
    """

    index: int
    seconds: float
    memory: float
    descriptors: int
    status: str


@dataclass(frozen=True)
class Trend:
    """How something went from frame `SETTLED` on.

    Attributes:
        start: Its level there; end: its level at the end. Both by a straight line through the medians of the rounds.
        least: The least and the most after that.
        most: See ``least``.
        flat: Whether it does not grow.
    """

    start: float
    end: float
    least: float
    most: float
    flat: bool


@dataclass(frozen=True)
class SoakReport:
    """What came of a soak.

    Attributes:
        frames: Number of frames.
        rounds: How often the object left and returned.
        counts: Frames by status.
        trends: By measure: ``memory``, ``descriptors``, ``seconds``; empty if the run is too short.
        samples: Every frame.
    """

    frames: int
    rounds: int
    counts: dict[str, int]
    trends: dict[str, Trend]
    samples: list[Sample] = field(repr=False)

    @property
    def flat(self) -> bool:
        """Whether nothing grows."""
        return all(trend.flat for trend in self.trends.values())


@dataclass(frozen=True, eq=False)
class LoopedClip:
    """A clip without end: the frames of `looped_clip`, over and over.

    See `tracking3d.video.source.FrameSource` for the other attributes.

    Attributes:
        images: ``(N, H, W, 3)`` one round.
        count: Number of frames that are given.
        until: Time, of `time.monotonic`, at which it ends all the same; None for never.
    """

    images: NDArray[np.uint8]
    count: int
    until: float | None = None
    name: str = "the looped clip"
    fps: float | None = 30.0
    intrinsics: Intrinsics | None = None
    intrinsics_origin: str = ""
    repeatable: bool = True

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Play it."""
        for index in range(self.count):
            if self.until is not None and index and time.monotonic() > self.until:
                return
            yield Frame(index, self.images[index % len(self.images)].copy(), index / 30, f"frame {index}")


def looped_clip(size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.bool_], Camera]:
    """One round, which begins as it ends: images ``(N, H, W, 3)``, the first mask ``(H, W)``, and the camera.

    The object turns, turns back, leaves the frame to the right, stays away, and returns.

    Args:
        size: ``(width, height)`` in pixels.
    """
    half = _TURNING // 2
    clip = synthesize(
        SyntheticSpec(frames=half + 1, size=size, supersample=1, degrees_per_frame=3, fill=0.5, noise=0.0)
    )
    empty = _without_object(clip.images, clip.masks)
    order = [*range(half + 1), *range(half - 1, -1, -1)]
    images = [clip.images[place] for place in order]
    first, mask = clip.images[0], clip.masks[0]
    gone = [_moved(first, mask, empty, step * size[0] // _LEAVING) for step in range(1, _LEAVING + 1)]
    images += [*gone, *[empty] * _ABSENT, *gone[::-1]]
    rng = np.random.default_rng(0)
    noisy = np.stack(images) + rng.normal(0, 1.5, (len(images), *images[0].shape))
    return np.clip(noisy.round(), 0, 255).astype(np.uint8), mask, clip.camera


def track_looped(
    config: PipelineConfig,
    folder: Path,
    frames: int = 10_000,
    hours: float | None = None,
    size: tuple[int, int] = (160, 120),
) -> SoakReport:
    """Track the looped clip and measure after every frame; Ctrl-C ends it with the measures until then.

    Args:
        config: The pipeline; its final refinement is left out.
        folder: The run folder.
        frames: How many frames.
        hours: End after that time, or not before it: frames are then without limit.
        size: ``(width, height)`` of the frames in pixels.

    Raises:
        OutputError: If the folder is in use or cannot be written.
        PluginError: If a plug-in fails.
    """
    images, mask, _ = looped_clip(size)
    until = None if hours is None else time.monotonic() + 3600 * hours
    source = LoopedClip(images, frames if hours is None else 10**9, until)
    samples: list[Sample] = []
    before = time.perf_counter()

    def measure(record: FrameRecord | SkippedFrame) -> None:
        nonlocal before
        now, (memory, _) = time.perf_counter(), resident_memory()
        status = str(record.status) if isinstance(record, FrameRecord) else "skipped"
        samples.append(Sample(record.index, now - before, memory, _open_descriptors(), status))
        before = time.perf_counter()

    solver = config.solver.model_copy(update={"final_refine": False})
    try:
        record(source, config.model_copy(update={"solver": solver}), folder, mask=mask, listener=measure)
    except KeyboardInterrupt:
        if not samples:
            raise
    counts: dict[str, int] = {}
    for sample in samples:
        counts[sample.status] = counts.get(sample.status, 0) + 1
    return SoakReport(
        len(samples), len(samples) // len(images), counts, trends(samples, len(images)), samples
    )


def trends(samples: list[Sample], round_length: int) -> dict[str, Trend]:
    """How each measure went from frame `SETTLED` on; nothing if there are not two rounds from there."""
    settled = samples[SETTLED:]
    if len(settled) < 2 * round_length:
        return {}
    found = {}
    # A file that is read or written is open for a moment, in some rounds whenever it is looked at.
    for name, allowed, level_of in (
        ("memory", MEMORY, np.median),
        ("descriptors", 0.0, np.min),
        ("seconds", SPEED, np.median),
    ):
        values = [getattr(sample, name) for sample in settled]
        # Whole rounds are alike; single frames are not: some enter the map, in some the object is searched for.
        rounds = len(values) // round_length
        levels = [float(level_of(values[n * round_length : (n + 1) * round_length])) for n in range(rounds)]
        slope, level = np.polyfit(np.arange(rounds), levels, 1)
        start, end = float(level), float(level + slope * (rounds - 1))
        flat = end <= start * (1 + allowed) + 1e-6
        found[name] = Trend(start, end, float(min(values)), float(max(values)), flat)
    return found


def _without_object(images: NDArray[np.uint8], masks: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The background ``(H, W, 3)``: from frames in which the object does not cover it, else painted over."""
    covered: NDArray[np.bool_] = np.logical_and.reduce(masks)
    always = cv2.dilate(covered.astype(np.uint8), np.ones((5, 5), np.uint8))
    free = np.where(masks[..., None], np.nan, images.astype(np.float32))
    seen = np.nan_to_num(np.nanmax(np.where(covered[..., None], 0, free), axis=0)).astype(np.uint8)
    return np.asarray(cv2.inpaint(seen, always, 3, cv2.INPAINT_TELEA), dtype=np.uint8)


def _moved(
    image: NDArray[np.uint8], mask: NDArray[np.bool_], background: NDArray[np.uint8], pixels: int
) -> NDArray[np.uint8]:
    """The object so many pixels further right, before the background."""
    width = mask.shape[1]
    moved, result = np.zeros_like(mask), background.copy()
    moved[:, pixels:] = mask[:, : width - pixels]
    result[moved] = image[:, : width - pixels][mask[:, : width - pixels]]
    return result


def _open_descriptors() -> int:
    process = psutil.Process()
    return process.num_fds() if psutil.POSIX else process.num_handles()
