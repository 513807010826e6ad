"""``index.html``: all runs of a batch on one page, to sort, to filter, and to go on to each report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tracking3d.batch.folder import BatchProgress, Failure
from tracking3d.batch.places import base, join_path, write
from tracking3d.report.rendering import render_page
from tracking3d.results import layout

MOST_PICTURES = 2000
"""Runs with a picture; of more, those with the least confidence have one."""


def write_overview(
    out: str,
    progress: BatchProgress,
    rows: Sequence[Mapping[str, Any]],
    pictures: Mapping[str, str],
    failures: Sequence[Failure],
    report: bool = True,
) -> None:
    """Write the page.

    Args:
        out: The folder of the batch.
        progress: How far it is.
        rows: Of the table of results.
        pictures: JPEG in base64 by run.
        failures: Videos that came to nothing.
        report: Whether the runs have reports.

    Raises:
        OutputError: If it cannot be written.
    """
    doubtful = sorted(rows, key=lambda row: 0.0 if row["confidence"] is None else row["confidence"])
    pictured = {row["run"] for row in doubtful[:MOST_PICTURES]}
    runs = [
        {
            **row,
            "picture": pictures.get(row["run"], "") if row["run"] in pictured else "",
            "link": f"{row['run']}/{layout.REPORT}" if report else "",
        }
        for row in sorted(rows, key=lambda row: row["run"])
    ]
    page = render_page(
        "batch.html",
        ("batch.js",),
        title=base(out) or "batch",
        progress=progress,
        runs=runs,
        failures=failures,
        frames=sum(row["frames"] for row in rows),
        seconds=sum(row["seconds"] for row in rows),
    )
    write(join_path(out, layout.INDEX), page)
