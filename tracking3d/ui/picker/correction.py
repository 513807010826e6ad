"""The picker's page for correcting one frame of an existing run."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tracking3d.config.loading import load_config
from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.frames import Box
from tracking3d.results import layout
from tracking3d.results.files import read_mask, write_atomic, write_mask, writing
from tracking3d.results.run_reader import is_finished
from tracking3d.ui.picker.drawing import DrawnObject, parse
from tracking3d.ui.picker.server import PageProgress, Picker, ShownRun
from tracking3d.ui.picker.session import Picked, PickingSession
from tracking3d.ui.web.access import Access
from tracking3d.video import parse_selection


@dataclass(frozen=True, eq=False)
class DrawnCorrection:
    """The drawing: a box if that is sufficient, else a mask."""

    frame: int  # index of the frame
    box: Box | None = None  # (x, y, width, height) in pixels, or None
    mask: NDArray[np.bool_] | None = None  # (H, W) bool, or None


class CorrectionPage(Picker):
    """Serves the page until it is closed.

    Args:
        session: The frames, and the tracker that makes the masks.
        name: What the object is called.
        present: Gives the run's mask ``(H, W)`` of a frame, or None.
        begin: Begins to correct the run; raises a `Tracking3dError` if it cannot.
        progress: How far that is.
        access: Where to listen, and whom to serve.
        port: The port, or the next one that is free; 0 for any.
    """

    def __init__(
        self,
        session: PickingSession,
        name: str,
        present: Callable[[int], NDArray[np.bool_] | None],
        begin: Callable[[DrawnCorrection], None],
        progress: Callable[[], PageProgress],
        access: Access,
        port: int,
    ) -> None:
        self._name, self._present, self._begin = name, present, begin
        super().__init__(session, lambda picked: ("", ""), access, port)
        self.run = ShownRun((), progress)

    def told(self, path: str) -> Any | None:
        """See `Picker.told`."""
        told = super().told(path)
        return told and {**told, "correcting": self._name}

    def order(self, path: str, body: bytes) -> tuple[Any, Callable[[], None]] | None:
        """See `Picker.order`: a mask to look at, or the correction; a run is not begun here.

        The mask of an empty drawing is the one that the run has. Paint starts from it.
        """
        if path not in ("/mask", "/correct"):
            return None
        drawn = parse(body, DrawnObject)
        present = self._present(drawn.frame)
        if path == "/mask":
            run_mask = present if drawn.is_empty else None
            return self.show(
                self.session.mask(drawn, present) if run_mask is None else run_mask, drawn.colour
            )
        if drawn.is_empty:
            raise InputError("Nothing is drawn yet; mark the object in this frame.")
        if drawn.only_a_box:
            # The mask is made to see that one can be.
            self.session.mask(drawn)
            self._begin(DrawnCorrection(drawn.frame, box=drawn.box))
        else:
            self._begin(DrawnCorrection(drawn.frame, mask=self.session.mask(drawn, present)))
        return {}, lambda: None


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
