"""Object probabilities per pixel as grey PNG: black is 0, white is 1; 8 or 16 bits.

Files are numbered by frame index. A frame whose mask was kept unchanged as the mask tracker gave it has no probability,
and no file. The run keeps 8 bits: 16 are the same 256 steps.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from tracking3d.errors import InputError, argument
from tracking3d.export.exported_run import ExportedRun
from tracking3d.results import layout


def write_probabilities(run: ExportedRun, folder: Path) -> None:
    """Write ``00000.png`` and so on, 0 to 255."""
    _write(run, folder, 255, np.uint8)


def write_probabilities_16(run: ExportedRun, folder: Path) -> None:
    """Write ``00000.png`` and so on, 0 to 65535."""
    _write(run, folder, 65535, np.uint16)


def _write(run: ExportedRun, folder: Path, white: int, kind: type[np.uint8 | np.uint16]) -> None:
    if not run.with_probability:
        raise InputError(_why_none(run))
    folder.mkdir(parents=True)
    for index in run.with_probability:
        probability = run.probability(index)
        assert probability is not None  # it was there a moment ago
        grey = np.rint(white * probability.astype(np.float64)).clip(0, white).astype(kind)
        Pillow.fromarray(grey).save(folder / f"{index:05d}.png")


def _why_none(run: ExportedRun) -> str:
    folder = run.reader.folder
    kept = (folder / layout.PROBABILITIES).is_dir()
    if kept and not run.reader.refined:
        return (
            f"The run {folder} keeps probabilities of the final estimates only; leave out "
            f"{argument('answers=', '--answers')}."
        )
    if kept:
        return f"The run {folder} has no frame with a fused mask and thus no probabilities; export its masks."
    return (
        f"The run {folder} stored no probabilities; track again with runtime.probabilities=true "
        f"({argument('overrides=', '--set')})."
    )
