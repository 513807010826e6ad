"""Does a pipeline keep up with a camera? A clip is played at a camera's rate, and estimates are timed as they come."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
from rich.table import Table

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.frames import Box, Frame, SkippedFrame
from tracking3d.pipeline.track import Session
from tracking3d.runtime.stage_times import StageTimes
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video.image_file import read_image
from tracking3d.video.latest_frames import newest
from tracking3d_bench.datasets.truth import Truth

WARM_UP = 10
"""Estimates that the figures of a settled session leave out: compilers and caches are warm only then."""


@dataclass(frozen=True)
class LiveReport:
    """What came of a clip that was played.

    A frame's lag is the time from its arrival to its estimate.

    Attributes:
        rate: Frames a second that were played.
        played: Number of frames that were played.
        taken: How many of them were tracked.
        dropped: How many were dropped to keep up.
        first_lag: Seconds of the first frame, which waits for the one-time work at the start.
        worst_lag, median_lag: Seconds over the frames after the first `WARM_UP`; None if there are none.
        end_lag: Seconds of the last frame: a pipeline that falls behind ends with the worst.
        answers_per_second: Estimates a second over the same frames as `worst_lag`.
        longest_gap: The most frames that were dropped in a row after the first `WARM_UP`.
        seconds_per_frame: Mean time of a frame in the session, over the same frames.
        stages: The same stage by stage; nothing is decoded or written.
    """

    rate: float
    played: int
    taken: int
    dropped: int
    first_lag: float
    worst_lag: float | None
    median_lag: float | None
    end_lag: float
    answers_per_second: float | None
    longest_gap: int
    seconds_per_frame: float | None = None
    stages: StageTimes | None = None


def play_live(config: PipelineConfig, truth: Truth, seconds: float = 20.0, rate: float = 15.0) -> LiveReport:
    """Play a clip to and fro at ``rate`` frames a second and track it from its box, dropping frames to keep up.

    The frames are read before, so that only what a camera would leave to do is timed.

    Raises:
        InputError: If the clip has no box in its first frame, its frames cannot be read, or rate or seconds are not
            positive.
        PluginError: If a plug-in fails.
    """
    if not (rate > 0 and seconds > 0):
        raise InputError(
            f"A clip cannot be played for {seconds} s at {rate} frames a second; give more than 0."
        )
    box = truth.box_in_frame()
    if box is None:
        raise InputError(f"{truth.name} has no box in its first frame; a mask tracker cannot start.")
    images = [read_image(path) for path in truth.frames]
    last = max(round(seconds * rate), 2)
    lags, indices, ends, stages = [], [], [], []
    session = None
    started = time.monotonic()
    for item in newest(_to_and_fro(images, last), rate):
        if isinstance(item, SkippedFrame):
            continue
        session = session or _session(config, item, box)
        stages.append(session.step(item).stages or StageTimes())
        ends.append(time.monotonic() - started)
        lags.append(ends[-1] - (item.time or 0.0))
        indices.append(item.index)
    settled = np.array(lags[WARM_UP:])
    mean = sum(stages[WARM_UP:], StageTimes()) * (1 / len(settled)) if len(settled) else None
    gaps = np.diff(indices[WARM_UP - 1 :]) - 1 if len(indices) > WARM_UP else np.zeros(1)
    span = ends[-1] - ends[WARM_UP - 1] if len(settled) else 0.0
    return LiveReport(
        rate=rate,
        played=last,
        taken=len(indices),
        dropped=last - len(indices),
        first_lag=lags[0],
        worst_lag=float(settled.max()) if len(settled) else None,
        median_lag=float(np.median(settled)) if len(settled) else None,
        end_lag=lags[-1],
        answers_per_second=len(settled) / span if span > 0 else None,
        longest_gap=int(gaps.max()),
        seconds_per_frame=None if mean is None else mean.whole,
        stages=mean,
    )


def format_live(report: LiveReport) -> Table:
    """The report for the terminal."""
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column()
    table.add_column(justify="right", style="bold")
    for title, text in (
        ("frames played", f"{report.played} at {report.rate:g} Hz"),
        ("tracked", str(report.taken)),
        ("dropped to keep up", str(report.dropped)),
        ("estimates a second, once settled", _text(report.answers_per_second, 1, "")),
        ("most dropped in a row, once settled", str(report.longest_gap)),
        ("lag of the first frame", _text(report.first_lag, 2, " s")),
        ("lag, median", _text(report.median_lag, 3, " s")),
        ("lag, worst", _text(report.worst_lag, 3, " s")),
        ("lag of the last frame", _text(report.end_lag, 3, " s")),
        ("seconds a frame, mean", _text(report.seconds_per_frame, 3, " s")),
        *(
            (f"of it {stage}", _text(getattr(report.stages, stage, None), 3, " s"))
            for stage in ("track", "encode", "solve", "map")
        ),
    ):
        table.add_row(title, text)
    return table


def _session(config: PipelineConfig, frame: Frame, box: Box) -> Session:
    return Session(config, make_prompt(frame, box), live=True)


def _to_and_fro(images: list[np.ndarray], length: int) -> Iterator[Frame]:
    """``length`` frames of a clip that is played to its end, back, and so on: it never jumps."""
    period = max(2 * (len(images) - 1), 1)
    for index in count():
        if index == length:
            return
        place = index % period
        yield Frame(index, images[min(place, period - place)], name=f"frame {index}")


def _text(value: float | None, digits: int, unit: str) -> str:
    return "-" if value is None else f"{value:.{digits}f}{unit}"
