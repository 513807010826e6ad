"""Reports of the objects of one video, and the page that links to them."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tracking3d.results import layout
from tracking3d.results.files import write_atomic
from tracking3d.results.overlay import OverlaySize
from tracking3d.results.redrawing import overlay_frames
from tracking3d.results.run_reader import RunReader
from tracking3d.ui.report.figures import status_counts
from tracking3d.ui.report.frame_pictures import jpeg_of
from tracking3d.ui.report.rendering import render_page
from tracking3d.ui.report.run_report import write_report, write_turntable_of


def write_reports(folders: Sequence[Path]) -> list[Path]:
    """Write the report of each run, and of more than one the page that links to them, in their parent folder.

    Args:
        folders: Run folders; of several, those of the objects of one video.

    Returns:
        What was written; the page with the links first.

    Raises:
        InputError: If one is no run folder, or damaged.
        OutputError: If something cannot be written.
    """
    links = [] if len(folders) < 2 else [_write_index(folders)]
    return links + [write_report(folder) for folder in folders]


def _write_index(folders: Sequence[Path]) -> Path:
    parent = folders[0].parent
    page = render_page("index.html", title=parent.resolve().name, objects=list(map(_card, folders)))
    write_atomic(parent / layout.INDEX, page)
    return parent / layout.INDEX


def _card(folder: Path) -> dict[str, Any]:
    run = RunReader(folder)
    # The first frame: there the object was pointed out.
    rows = OverlaySize.of(run.camera).picture
    pictures = [jpeg_of(image[:rows]) for image in overlay_frames(run, [0])]
    return {
        "name": folder.name,
        "link": f"{folder.name}/{layout.REPORT}",
        "counts": status_counts(run.frames),
        "picture": base64.b64encode(pictures[0]).decode("ascii") if pictures else "",
    }


def renew_report(folder: Path) -> list[Path]:
    """Write the report and the turntable of a run again, as far as it has them.

    Args:
        folder: The run folder.

    Returns:
        What was written.

    Raises:
        InputError: If the run is damaged.
        OutputError: If something cannot be written.
    """
    report, turntable = folder / layout.REPORT, folder / layout.TURNTABLE
    written = [path for path in (report, turntable) if path.is_file()]
    if report in written:
        write_report(folder, turntable=turntable in written)
    elif turntable in written:
        write_turntable_of(folder)
    return written
