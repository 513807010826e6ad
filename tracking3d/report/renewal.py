"""The report and the turntable of a run whose mesh was replaced."""

from __future__ import annotations

from pathlib import Path

from tracking3d.report.run_report import write_report, write_turntable_of
from tracking3d.results import layout


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
