"""Masks as indexed PNG, in the folders of DAVIS and of YouTube-VOS: 0 is the background, 1 the object.

There is a mask for every frame from the first to the last; of one that was skipped it is empty. Files are numbered by
frame index. https://davischallenge.org, https://youtube-vos.org
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.export.exported_run import ExportedRun

_PALETTE = (0, 0, 0, 128, 0, 0)
"""Black and the dark red that both data sets have as their first colour."""


def write_davis(run: ExportedRun, folder: Path) -> None:
    """Write results as DAVIS's tools read them: ``RUN/00000.png``."""
    _write_masks(run, folder / run.name)


def write_youtube_vos(run: ExportedRun, folder: Path) -> None:
    """Write results as YouTube-VOS has them: ``Annotations/RUN/00000.png`` and ``meta.json``."""
    names = _write_masks(run, folder / "Annotations" / run.name)
    seen = [name for name, index in zip(names, run.span, strict=True) if run.mask(index).any()]
    meta = {"videos": {run.name: {"objects": {"1": {"category": "object", "frames": seen}}}}}
    (folder / "meta.json").write_text(json.dumps(meta, indent=1) + "\n", encoding="ascii")


def _write_masks(run: ExportedRun, folder: Path) -> list[str]:
    """Write the masks; names without suffix."""
    folder.mkdir(parents=True)
    names = [f"{index:05d}" for index in run.span]
    for name, index in zip(names, run.span, strict=True):
        _index_image(run.mask(index)).save(folder / f"{name}.png")
    return names


def _index_image(mask: NDArray[np.bool_]) -> Pillow.Image:
    image = Pillow.fromarray(mask.astype(np.uint8))
    image.putpalette(_PALETTE)
    return image
