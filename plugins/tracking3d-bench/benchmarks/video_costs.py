"""What tracking many hours of video costs, by the measured figures of one run: time, disk, memory, and what binds."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.table import Table

from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d.results.run_reader import RunReader


@dataclass(frozen=True)
class RunFigures:
    """What one run took.

    Attributes:
        seconds: Seconds of one processor a frame, both passes.
        decoding: Seconds of these for reading the frame, both times.
        seconds_once: Seconds of the start, the global refinement, mesh, texture and images.
        bytes_read: Bytes of the video, a frame.
        bytes_written: Bytes of masks, lines and overlay, a frame.
        bytes_once: Bytes of the rest of the run folder.
        memory: Most bytes that the process held.
    """

    seconds: float
    decoding: float
    seconds_once: float
    bytes_read: float
    bytes_written: float
    bytes_once: float
    memory: float


@dataclass(frozen=True)
class Machine:
    """What a machine has.

    Attributes:
        processors: Each as fast as the one that was measured.
        memory: Bytes.
        disk: Bytes a second that it writes.
        network: Bytes a second that videos come by.
    """

    processors: int = 16
    memory: float = 64e9
    disk: float = 200e6
    network: float = 125e6


@dataclass(frozen=True)
class Cost:
    """What some hours of video cost.

    Attributes:
        processor_hours: Hours of processor time.
        written: Bytes of run folders.
        read: Bytes of video.
        workers: On one machine, at a time.
        machine_hours: With that many.
        limits: Frames a second that each resource of a machine allows, by its name.
    """

    processor_hours: float
    written: float
    read: float
    workers: int
    machine_hours: float
    limits: Mapping[str, float]

    @property
    def bottleneck(self) -> str:
        """What allows the fewest frames a second."""
        return min(self.limits, key=lambda name: self.limits[name])


def figures_of(run: Path, video: Path | None = None) -> RunFigures:
    """What a finished run took; the video's own size is that of ``video``, a file or a folder.

    Raises:
        InputError: If the run is not finished or has no frames.
    """
    reader = RunReader(run)
    if reader.state != "finished" or not reader.frames:
        raise InputError(f"{run} is not finished; its figures say nothing of a whole run.")
    timings, count = reader.description["timings"], len(reader.frames)
    decoding = float((timings.get("stages") or {}).get("decode") or 0.0)
    again = sum(one.seconds for one in reader.frames if one.refined and math.isfinite(one.seconds))
    if stages := reader.refinement_stages:
        decoding += stages.decode
    each = float(timings["seconds_per_frame_mean"]) + again / count
    written = sum(
        _size(run / name)
        for name in (
            layout.MASKS,
            layout.INITIAL_MASKS,
            f"{layout.CAUSAL}/{layout.MASKS}",
            layout.FRAMES,
            layout.OVERLAY,
        )
    )
    return RunFigures(
        seconds=each,
        decoding=decoding / count,
        seconds_once=max(float(timings["seconds_total"]) - each * count, 0.0),
        bytes_read=(_size(video) if video else 0) / count,
        bytes_written=written / count,
        bytes_once=_size(run) - written,
        memory=1e6 * float(reader.description.get("peak_memory_mb") or 0.0),
    )


def cost_of(
    hours: float, figures: RunFigures, machine: Machine, *, fps: float = 30.0, minutes: float = 1.0
) -> Cost:
    """What so many hours of video cost.

    Args:
        hours: Hours of video.
        figures: Figures of one run.
        machine: One of the machines.
        fps: Frames a second of the videos.
        minutes: Mean length of a video.

    Raises:
        InputError: If a number makes no sense.
    """
    for name, value in {"hours": hours, "fps": fps, "minutes": minutes, "seconds": figures.seconds}.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}; it has to be more than 0.")
    frames, in_a_video = 3600 * fps * hours, 60 * fps * minutes
    seconds = figures.seconds + figures.seconds_once / in_a_video
    written = figures.bytes_written + figures.bytes_once / in_a_video
    fit = int(machine.memory // figures.memory) if figures.memory > 0 else machine.processors
    if fit < 1:
        raise InputError("One run needs more memory than the machine has.")
    limits = {
        "processors": machine.processors / seconds,
        "memory": fit / seconds,
        "disk": machine.disk / written if written else math.inf,
        "network": machine.network / (2 * figures.bytes_read) if figures.bytes_read else math.inf,
    }
    rate = min(limits.values())
    return Cost(
        processor_hours=frames * seconds / 3600,
        written=frames * written,
        read=frames * figures.bytes_read,
        workers=min(machine.processors, fit),
        machine_hours=frames / rate / 3600,
        limits=limits,
    )


def format_costs(costs: Mapping[str, Cost]) -> Table:
    """A row for each, by what it is called."""
    table = Table("", "processor hours", "workers", "machine hours", "written", "read", "bottleneck")
    for name, cost in costs.items():
        table.add_row(name, *row_of(cost))
    return table


def markdown(costs: Mapping[str, Cost]) -> str:
    """The same as a table of Markdown."""
    head = "| | processor hours | workers a machine | machine hours | written | read | bottleneck |\n"
    head += "|---|---|---|---|---|---|---|\n"
    return head + "".join(f"| {name} | {' | '.join(row_of(cost))} |\n" for name, cost in costs.items())


def row_of(cost: Cost) -> list[str]:
    """A cost in words."""
    return [
        f"{cost.processor_hours:,.0f}",
        str(cost.workers),
        f"{cost.machine_hours:,.0f}",
        f"{cost.written / 1e12:.1f} TB",
        f"{cost.read / 1e12:.1f} TB",
        cost.bottleneck,
    ]


def as_json(cost: Cost) -> dict[str, object]:
    """A cost as JSON has it."""
    return {**asdict(cost), "bottleneck": cost.bottleneck}


def _size(path: Path) -> int:
    if path.is_file():
        return path.stat().st_size
    kept = {layout.STATE, layout.REFINING}
    if not path.is_dir():
        return 0
    return sum(
        file.stat().st_size for file in path.rglob("*") if file.is_file() and not kept & set(file.parts)
    )
