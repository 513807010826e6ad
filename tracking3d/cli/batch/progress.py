"""Progress of a batch: one line per worker and one for the whole, or one line of JSON per event."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

from tracking3d.batch.folder import BatchProgress as HowFar
from tracking3d.cli.progress import duration_in_words

if TYPE_CHECKING:
    from tracking3d.batch.running import BatchEvent, Listener

_MOST_WORKERS = 32
"""Most lines of workers on the terminal."""
_EVERY = 10.0  # seconds between two events of progress


@contextmanager
def show_batch_progress(quiet: bool, as_json: bool) -> Iterator[Listener]:
    """Show the progress of a batch; yields the listener.

    Args:
        quiet: Show failures only.
        as_json: Print events on the standard output instead.
    """
    if as_json:
        yield _events()
        return
    console = Console(stderr=True)
    bars = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[said]}"),
        TimeElapsedColumn(),
        console=console,
        disable=quiet or not console.is_terminal,
        transient=True,
    )
    every = bars.add_task("all", total=None, said="")
    lines: dict[str, TaskID] = {}

    def listener(happening: BatchEvent) -> None:
        how_far = happening.progress
        done = how_far.finished + how_far.failed
        bars.update(every, total=how_far.total, complete=done, said=in_words(how_far))
        for worker, about in list(how_far.running.items())[:_MOST_WORKERS]:
            if worker not in lines:
                lines[worker] = bars.add_task(escape(worker), total=None, said="")
            bars.update(
                lines[worker],
                total=about.get("of"),
                complete=about.get("frames", 0),
                said=escape(", ".join(str(about[key]) for key in ("video", "step", "stage") if key in about)),
                visible=True,
            )
        for worker, line in lines.items():
            if worker not in how_far.running:
                bars.update(line, visible=False)
        if text := _line(happening):
            if not quiet:
                bars.console.print(escape(text), highlight=False, soft_wrap=True)
            elif happening.event == "failed":
                typer.echo(text, err=True)

    with bars:
        yield listener


def in_words(progress: HowFar) -> str:
    """The progress of a batch in one line."""
    parts = [f"{progress.finished} of {progress.total} videos"]
    if progress.failed:
        parts.append(f"{progress.failed} failed")
    if progress.seconds_to_go is not None:
        parts.append(f"{duration_in_words(progress.seconds_to_go)} left")
    return ", ".join(parts)


def _line(happening: BatchEvent) -> str:
    about, video = happening.about, happening.video
    if happening.event == "finished":
        rows = about["rows"]
        frames, seconds = sum(row["frames"] for row in rows), sum(row["seconds"] for row in rows)
        known = [row["confidence"] for row in rows if row["confidence"] is not None]
        sure = f", confidence {sum(known) / len(known):.2f}" if known else ""
        note = f"; {rows[0]['note']}" if rows[0].get("note") else ""
        return f"{video}: {frames} frames in {seconds:.0f} s{sure}{note}"
    if happening.event == "again":
        return f"{video} failed and is tried again: {about['reason']}"
    if happening.event == "failed":
        return f"{video} failed: {about['reason']}"
    if happening.event == "batch":
        before = f", {happening.progress.before} of them earlier" if happening.progress.before else ""
        return in_words(happening.progress) + before
    return ""


def _events() -> Listener:
    last: dict[str, float] = {}

    def listener(happening: BatchEvent) -> None:
        now = time.monotonic()
        if happening.event == "progress":
            if now - last.get(happening.video, 0.0) < _EVERY:
                return
            last[happening.video] = now
        else:
            last.pop(happening.video, None)
        all_of_it = {key: value for key, value in asdict(happening.progress).items() if key != "running"}
        line = {"event": happening.event, "time": time.time(), "video": happening.video or None}
        typer.echo(json.dumps({**line, **happening.about, "batch": all_of_it}))

    return listener
