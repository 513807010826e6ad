"""The refined estimates of a run: saved separately until all are there, then they replace the causal ones.

Until then the run folder holds the causal estimates whole, whatever ends the refinement.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Assessment, FrameEstimate
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.results import description, layout
from tracking3d.results.files import take_over_probability, write_atomic, writing
from tracking3d.results.pictures import Pictures
from tracking3d.results.records import FrameRecord
from tracking3d.results.refined_estimates import RefinedEstimates, keep_masks, write_refined
from tracking3d.runtime.stage_times import StageTimes, measure


class RefinementWriter(RefinedEstimates):
    """Writes the estimates of the final refinement of one run.

    Args:
        folder: The run folder.
        camera: The camera of the full frame.
        fps: Speed of the overlay video.
        causal: The causal estimate for every frame.
        kept: Bytes of estimates that were saved when the run was stopped.
        seconds: Wall time that they took.

    Attributes:
        pictures: Overlay and crops of the second pass.
        together: Times of the global refinement of the map, before the frames.
        kept: Number of estimates that are those of an earlier refinement.
        passed_over: How many frames each pass has left as they were, by its name.
        start: Where the refined model started; None until that is decided.

    Raises:
        OutputError: If the folder cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        camera: Camera,
        fps: float,
        causal: Sequence[FrameRecord],
        kept: int = 0,
        seconds: float = 0.0,
    ) -> None:
        aside = folder / layout.REFINING
        self._started = time.monotonic() - seconds
        self._taken_over = False
        self.together, self.kept = StageTimes(), 0
        self.passed_over: dict[str, int] = {}
        self.start: description.StartOfModel | None = None
        self.pictures = Pictures(aside / layout.OVERLAY, camera, fps)
        with writing(aside):
            (aside / layout.MASKS).mkdir(parents=True, exist_ok=True)
            undo_taking_over(folder)
            with (aside / layout.FRAMES).open("ab") as lines:
                lines.truncate(kept)
        super().__init__(folder, causal, (camera.height, camera.width))

    @property
    def lines(self) -> int:
        """Bytes of estimates that are written."""
        return (self._aside / layout.FRAMES).stat().st_size

    @property
    def seconds(self) -> float:
        """Wall time of the refinement so far, pauses left out."""
        return time.monotonic() - self._started

    def draw(self, frame: Frame, mask: NDArray[np.bool_], initial: NDArray[np.bool_] | None) -> None:
        """Draw the estimate for a frame.

        Args:
            frame: The frame.
            mask: ``(H, W)`` the estimate's.
            initial: ``(H, W)`` what the mask tracker gave.

        Raises:
            OutputError: If the video cannot be written.
        """
        record = self.estimate(frame.index)
        with measure("write") as watch:
            self.pictures.add_kept(frame, record, mask, initial)
        if frame.index in self._records:
            self._records[frame.index] = record.and_wrote(watch.times.write)

    def write(
        self, estimate: FrameEstimate | None, frame: Frame, initial: NDArray[np.bool_] | None
    ) -> FrameRecord:
        """Keep the refined estimate for one frame; None lets the causal one stand.

        Args:
            estimate: The estimate.
            frame: The frame.
            initial: ``(H, W)`` what the mask tracker gave.

        Returns:
            What the frame's estimate will be.

        Raises:
            OutputError: If it cannot be written.
        """
        if estimate is None:
            return self.causal[frame.index]
        record = write_refined(
            self._aside, estimate, frame, self.causal[frame.index], initial, self.writes_probabilities
        )
        with writing(self._aside), (self._aside / layout.FRAMES).open("ab") as lines:
            lines.write(record.to_json().encode() + b"\n")
        self._records[record.index] = record
        return record

    def keep(self, record: FrameRecord, earlier: Path) -> None:
        """Take the refined estimate for one frame from another run of the same frames.

        Args:
            record: The estimate.
            earlier: The folder of that run.

        Raises:
            OutputError: If it cannot be written.
        """
        keep_masks(earlier, self._aside, record.index)
        with writing(self._aside), (self._aside / layout.FRAMES).open("ab") as lines:
            lines.write(record.to_json().encode() + b"\n")
        self._records[record.index] = record
        self.kept += earlier != self._folder

    def take_over(self, append: Callable[[Sequence[FrameRecord]], None]) -> None:
        """Put masks and video in their places; what they replace goes to ``causal/``, the mesh too.

        Readers take them for the estimates once their lines are there, and not before.

        Args:
            append: Appends records to ``frames.jsonl``, all or none.

        Raises:
            OutputError: If a file cannot be moved or written.
        """
        self.pictures.close()
        causal = self._folder / layout.CAUSAL
        with writing(self._folder):
            (causal / layout.MASKS).mkdir(parents=True, exist_ok=True)
            for record in self._records.values():
                place = layout.mask_path(self._folder, record.index)
                place.replace(layout.mask_path(causal, record.index))
                if (decided := self._decided.get(record.index)) is not None:
                    write_atomic(place, decided)  # the mask that it was decided from stays until the end
                else:
                    layout.mask_path(self._aside, record.index).replace(place)
            for name in layout.MESH_FILES:
                if (self._folder / name).is_file():
                    (self._folder / name).replace(causal / name)
        append(list(self._records.values()))
        self._taken_over = True
        with writing(self._folder):
            for record in self._records.values():
                take_over_probability(self._aside, self._folder, record.index)
            if (self._aside / layout.OVERLAY).is_file():
                (self._aside / layout.OVERLAY).replace(self._folder / layout.OVERLAY)

    def give_up(self, keep: bool) -> None:
        """Leave the causal estimates unchanged; the refined ones stay for another try, or are removed.

        Raises:
            OutputError: If it cannot be done.
        """
        self.pictures.close()
        if not self._taken_over:
            with writing(self._folder):
                undo_taking_over(self._folder)
        if not keep:
            clear_refinement(self._folder)

    def describe(self, state: str, reason: str = "") -> dict[str, Any]:
        """What ``run.json`` says of it, see `tracking3d.results.description.refinement`."""
        refined = list(self._records.values()) if self._taken_over else []
        causal = list(self.causal.values())
        return description.refinement(
            state,
            reason,
            causal,
            refined,
            self.seconds,
            self.together,
            self.kept,
            self.start,
            self.passed_over,
        )


def adjusted_record(
    estimate: FrameRecord,
    T_cam_obj: NDArray[np.float64],
    assessment: Assessment | None = None,
    evidence: Mapping[str, float] | None = None,
) -> FrameRecord:
    """A refined estimate with the pose that it has in the end.

    Args:
        estimate: As it was.
        T_cam_obj: ``(4, 4)``, for the final camera.
        assessment: Its final status and confidence; unchanged if left out.
        evidence: What that comes from, added to the diagnostics.
    """
    diagnostics = estimate.diagnostics | dict(evidence or {})
    estimate = replace(estimate, T_cam_obj=T_cam_obj, camera=None, diagnostics=diagnostics)
    if assessment is None:
        return estimate
    return replace(
        estimate, status=assessment.status, reason=assessment.reason, confidence=assessment.confidence
    )


def clear_refinement(folder: Path) -> None:
    """Remove the separate files of the final refinement of a run, if there are any.

    Raises:
        OutputError: If it cannot be removed.
    """
    aside = folder / layout.REFINING
    with writing(aside):
        for file in layout.run_files(folder):
            if file.is_relative_to(aside):
                file.unlink()
        if aside.is_dir():
            _remove_folders(aside)


def undo_taking_over(folder: Path) -> None:
    """Restore the causal estimates and move the refined masks away, also after a kill in between.

    Raises:
        OSError: If a file cannot be moved.
    """
    causal, aside = folder / layout.CAUSAL, folder / layout.REFINING
    if not causal.is_dir():
        return
    (aside / layout.MASKS).mkdir(parents=True, exist_ok=True)
    for file in layout.run_files(folder):
        if file.is_relative_to(causal):
            place = folder / file.relative_to(causal)
            refined = aside / file.relative_to(causal)
            if file.parent.name == layout.MASKS and place.is_file() and not refined.is_file():
                place.replace(refined)
            file.replace(place)
    _remove_folders(causal)


def _remove_folders(folder: Path) -> None:
    """Remove the emptied folder and its folders of masks."""
    for inner in (layout.MASKS, layout.INITIAL_MASKS, layout.PROBABILITIES):
        with suppress(FileNotFoundError):
            (folder / inner).rmdir()
    folder.rmdir()
