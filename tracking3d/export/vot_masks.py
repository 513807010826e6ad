"""Masks as the VOT toolkit writes regions: one line a frame, run-length encoded; see `tracking3d.trackers.vot_regions`.

Lines have no number: line n is frame n of those that were asked for, and one that was skipped is ``0``, no region.
"""

from __future__ import annotations

from pathlib import Path

from tracking3d.export.exported_run import ExportedRun
from tracking3d.trackers.vot_regions import Special, encode_mask, format_region


def write_vot(run: ExportedRun, path: Path) -> None:
    """Write the masks."""
    answered = run.records
    regions = [encode_mask(run.mask(index)) if index in answered else Special(0) for index in run.span]
    path.write_text("".join(f"{format_region(region)}\n" for region in regions), encoding="ascii")
