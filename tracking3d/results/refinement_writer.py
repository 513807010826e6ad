"""The second answers of a run: kept aside until all are there, then put in the place of the causal ones.

Until then the run folder holds the causal answers whole, whatever ends the refinement.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.results import description, layout
from tracking3d.results.files import read_mask, write_mask, writing
from tracking3d.results.pictures import Pictures
from tracking3d.results.records import FrameRecord
from tracking3d.stages import StageTimes, measured


class RefinementWriter:
    """Writes the answers of the final refinement of one run.

    Args:
        folder: The run folder.
        camera: The camera of the full frame.
        fps: Speed of the overlay video.
        causal: The causal answer for every frame.

    Attributes:
        causal: The causal answers by frame index.
        pictures: Overlay and crops of the second pass.
        together: What it took to solve everything once more, before the frames.

    Raises:
        OutputError: If the folder cannot be written.
    """

    def __init__(self, folder: Path, camera: Camera, fps: float, causal: Sequence[FrameRecord]) -> None:
        self._folder, self._aside = folder, folder / layout.REFINING
        self._started = time.monotonic()
        self._records: list[FrameRecord] = []
        self._taken_over = False
        self.together = StageTimes()
        self.causal = {record.index: record for record in causal}
        self.pictures = Pictures(self._aside / layout.OVERLAY, camera, fps)
        with writing(self._aside):
            (self._aside / layout.MASKS).mkdir(parents=True, exist_ok=True)

    def write(self, estimate: FrameEstimate | None, frame: Frame) -> FrameRecord:
        """Keep the second answer for one frame; None lets the causal one stand.

        Returns:
            What the frame's answer will be.

        Raises:
            OutputError: If it cannot be written.
        """
        causal, initial = self.causal[frame.index], self.initial_mask(frame.index)
        if estimate is None:
            self.pictures.add(frame, self._causal_estimate(frame, initial), causal)
            return causal
        estimate = replace(
            estimate, refined=True, initial_mask=initial, keyframe=estimate.keyframe or causal.keyframe
        )
        with measured("write") as watch:
            record = FrameRecord.of(estimate, frame.name, initial, revision=True)
            write_mask(layout.mask_path(self._aside, frame.index), estimate.mask)
            self.pictures.add(frame, estimate, record)
        record = record.and_wrote(watch.times.write)
        self._records.append(record)
        return record

    def initial_mask(self, index: int) -> NDArray[np.bool_] | None:
        """What the mask tracker gave for frame ``index``, ``(H, W)`` bool, or None."""
        return read_mask(layout.initial_mask_path(self._folder, index))

    def take_over(self, append: Callable[[Sequence[FrameRecord]], None]) -> None:
        """Put masks and video in their places; what they replace goes to ``causal/``, the mesh too.

        Readers take them for the answers once their lines are there, and not before.

        Args:
            append: Appends records to ``frames.jsonl``, all or none.

        Raises:
            OutputError: If a file cannot be moved or written.
        """
        self.pictures.close()
        causal = self._folder / layout.CAUSAL
        with writing(self._folder):
            (causal / layout.MASKS).mkdir(parents=True, exist_ok=True)
            for record in self._records:
                place = layout.mask_path(self._folder, record.index)
                place.replace(layout.mask_path(causal, record.index))
                layout.mask_path(self._aside, record.index).replace(place)
            for name in layout.MESH_FILES:
                if (self._folder / name).is_file():
                    (self._folder / name).replace(causal / name)
        append(self._records)
        self._taken_over = True
        with writing(self._folder):
            if (self._aside / layout.OVERLAY).is_file():
                (self._aside / layout.OVERLAY).replace(self._folder / layout.OVERLAY)
        self._clear()

    def give_up(self) -> None:
        """Remove what was made; the causal answers are as they were.

        Raises:
            OutputError: If it cannot be removed.
        """
        self.pictures.close()
        causal = self._folder / layout.CAUSAL
        if causal.is_dir() and not self._taken_over:
            with writing(causal):
                for file in layout.run_files(self._folder):
                    if file.is_relative_to(causal):
                        file.replace(self._folder / file.relative_to(causal))
                _remove_folders(causal)
        self._clear()

    def described(self, state: str, reason: str = "") -> dict[str, Any]:
        """What ``run.json`` says of it, see `tracking3d.results.description.refinement`."""
        seconds = time.monotonic() - self._started
        refined = self._records if self._taken_over else []
        causal = list(self.causal.values())
        return description.refinement(state, reason, causal, refined, seconds, self.together)

    def _causal_estimate(self, frame: Frame, initial: NDArray[np.bool_] | None) -> FrameEstimate:
        """The causal answer as far as it is kept: enough to draw it."""
        causal = self.causal[frame.index]
        mask = read_mask(layout.mask_path(self._folder, frame.index))
        return FrameEstimate(
            index=frame.index,
            time=frame.time,
            T_cam_obj=causal.T_cam_obj,
            mask=np.zeros(frame.size, dtype=np.bool_) if mask is None else mask,
            initial_mask=initial,
            status=causal.status,
            reason=causal.reason,
            confidence=causal.confidence,
            keyframe=causal.keyframe,
        )

    def _clear(self) -> None:
        with writing(self._aside):
            for file in layout.run_files(self._folder):
                if file.is_relative_to(self._aside):
                    file.unlink()
            if self._aside.is_dir():
                _remove_folders(self._aside)


def _remove_folders(folder: Path) -> None:
    """Remove the emptied folder and its folder of masks."""
    (folder / layout.MASKS).rmdir()
    folder.rmdir()
