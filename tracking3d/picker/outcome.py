"""The result of picking: the files and the command of a run."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import yaml

from tracking3d.config.loading import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import Tracking3dError
from tracking3d.picker.drawing import DrawnObject
from tracking3d.picker.session import Picked
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_atomic, write_mask, writing
from tracking3d.results.run_reader import is_finished
from tracking3d.video import parse_selection

FOLDER = layout.PICKED
"""Name of the file with the drawn masks in the run folder."""
DESCRIPTION, SETTINGS = f"{FOLDER}.json", f"{FOLDER}.yaml"


def save_outcome(picked: Picked, config: PipelineConfig, folder: Path, source: str) -> None:
    """Write what was picked into the run folder: masks, names and colours, and the settings as YAML.

    Args:
        picked: What was picked.
        config: The settings of the run.
        folder: The run folder; made with its parents. Nothing is written elsewhere.
        source: The video.

    Raises:
        OutputError: If it cannot be written.
    """
    with writing(folder):
        (folder / FOLDER if picked.masks else folder).mkdir(parents=True, exist_ok=True)
    for path, mask in zip(mask_files(picked, folder), picked.masks, strict=True):
        write_mask(path, mask)
    description = {
        "source": source,
        "frame": picked.frame,
        "objects": [one.model_dump(mode="json") for one in picked.objects],
        "boxes": picked.boxes,
    }
    write_atomic(folder / DESCRIPTION, (json.dumps(description, indent=1) + "\n").encode())
    write_atomic(folder / SETTINGS, settings_as_yaml(config).encode())


def read_outcome(folder: Path) -> Picked | None:
    """What was picked for the run in a folder that was stopped and can be continued; None if there is none."""
    runs = [path.parent for path in (*folder.glob(layout.RUN), *folder.glob(f"object_*/{layout.RUN}"))]
    if not any(layout.has_state(run) for run in runs) or all(is_finished(run) for run in runs):
        return None
    try:
        told = json.loads((folder / DESCRIPTION).read_bytes())
        objects = tuple(DrawnObject.model_validate(one) for one in told["objects"])
        config = load_config(folder / SETTINGS)
        picked = Picked(int(told["frame"]), objects, [tuple(box) for box in told["boxes"]], config=config)
    except (OSError, ValueError, KeyError, TypeError, Tracking3dError):
        return None
    files = [] if picked.boxes else [folder / FOLDER / f"object_{n}.png" for n in range(len(objects))]
    masks = [mask for file in files if (mask := read_mask(file)) is not None]
    return replace(picked, masks=masks) if picked.boxes or len(masks) == len(objects) else None


def mask_files(picked: Picked, folder: Path) -> list[Path]:
    """Where the masks of `save_outcome` lie."""
    return [folder / FOLDER / f"object_{number}.png" for number in range(len(picked.masks))]


def settings_as_yaml(config: PipelineConfig) -> str:
    """The settings as a file that ``--config`` takes."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def command_of(picked: Picked, folder: Path, source: str, frames: str | None) -> str:
    """The command line of the run; its files are those of `save_outcome`.

    Args:
        picked: What was picked.
        folder: The run folder.
        source: The video.
        frames: ``START:STOP:STEP``, the frames that were asked for.
    """
    words = ["tracking3d", "run", source]
    for box in picked.boxes:
        words += ["--box", ",".join(f"{side:g}" for side in box)]
    for path in mask_files(picked, folder):
        words += ["--mask", str(path)]
    if picked.frame != parse_selection(frames).start:
        words += ["--start-frame", str(picked.frame)]
    if frames:
        words += ["--frames", frames]
    words += ["--config", str(folder / SETTINGS), "--out", str(folder)]
    return shlex.join(words)
