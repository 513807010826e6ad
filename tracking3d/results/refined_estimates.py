"""The estimates of a run in its final refinement: refined ones are saved separately until all are there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, MaskSource
from tracking3d.frames import Frame, MaskEstimate, mask_iou_or_none
from tracking3d.results import layout
from tracking3d.results.files import (
    decode_mask,
    link_or_copy,
    mask_file,
    read_mask,
    read_occluder,
    write_mask,
    write_probability,
    writing,
)
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.runtime.stage_times import measure


class RefinedEstimates:
    """The refined estimate of each frame, or the causal one if there is none; any process can read them.

    Args:
        folder: The run folder.
        causal: The causal estimate of every frame.
        size: ``(height, width)`` of the frames.

    Attributes:
        causal: The causal estimates by frame index.
    """

    def __init__(self, folder: Path, causal: Iterable[FrameRecord], size: tuple[int, int]) -> None:
        self._folder, self._aside, self._size = folder, folder / layout.REFINING, size
        self.causal = {record.index: record for record in causal}
        self._records = {record.index: record for record in read_records(self._aside / layout.FRAMES)}
        self._decided: dict[int, bytes] = {}  # masks as PNG

    @classmethod
    def of_folder(cls, folder: Path, size: tuple[int, int]) -> RefinedEstimates:
        """The estimates of a run that is stopped; ``size`` is that of its frames."""
        return RefinedEstimates(folder, RunReader(folder, refined=False).frames, size)

    @property
    def writes_probabilities(self) -> bool:
        """Whether the run keeps the probabilities of masks."""
        return (self._folder / layout.PROBABILITIES).is_dir()

    def estimate(self, index: int) -> FrameRecord:
        """The estimate of frame ``index`` as it is now."""
        return self._records.get(index) or self.causal[index]

    def all(self) -> list[FrameRecord]:
        """The estimate of every frame as it is now, in the order of the causal ones."""
        return [self.estimate(index) for index in self.causal]

    def mask(self, record: FrameRecord) -> NDArray[np.bool_]:
        """The mask ``(H, W)`` of an estimate; empty if it cannot be read."""
        if record.refined and (decided := self._decided.get(record.index)) is not None:
            mask = decode_mask(decided)
        else:
            mask = read_mask(layout.mask_path(self._aside if record.refined else self._folder, record.index))
        return np.zeros(self._size, bool) if mask is None else mask

    def initial_mask(self, index: int) -> NDArray[np.bool_] | None:
        """The mask of frame ``index`` by the mask tracker, or of a photo by itself, ``(H, W)`` bool, or None."""
        return read_mask(layout.initial_mask_path(self._with_initial_mask(index), index))

    def occluder(self, index: int) -> NDArray[np.bool_] | None:
        """What is in front of the object in frame ``index``, beside `initial_mask`, ``(H, W)`` bool, or None."""
        return read_occluder(self._with_initial_mask(index), index)

    def _with_initial_mask(self, index: int) -> Path:
        own = layout.initial_mask_path(self._aside, index).is_file()
        return self._aside if own else self._folder

    def is_given(self, index: int) -> bool:
        """Whether the user has given the mask of frame ``index``."""
        return layout.prompt_path(self._folder, index).is_file()

    def put_initial_mask(self, index: int, estimate: MaskEstimate) -> None:
        """Take another initial mask of frame ``index`` in the refinement; the mask tracker's stays in the folder.

        Raises:
            OutputError: If it cannot be written.
        """
        path, mask = layout.initial_mask_path(self._aside, index), estimate.found
        with writing(path):
            path.parent.mkdir(exist_ok=True)
        write_mask(path, np.zeros(self._size, bool) if mask is None else mask, estimate.occluder)

    def visible(self, index: int, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """What is seen of the object, ``(H, W)``: its mask in frame ``index`` without what is in front of it."""
        occluder = self.occluder(index)
        return mask if occluder is None else mask & ~occluder

    def put(self, record: FrameRecord, mask: bytes | None = None) -> None:
        """Replace a refined estimate, and its mask if that is given as PNG; causal ones stand.

        It is not saved for a run that is stopped here and resumed later: that computes it again.
        """
        if record.index in self._records:
            self._records[record.index] = record
            if mask is not None:
                self._decided[record.index] = mask

    def put_retracked(self, estimate: FrameEstimate, name: str) -> bytes:
        """Put an estimate that was made after all others in the place of the first; returns its mask as PNG.

        Raises:
            OutputError: If its probability cannot be written.
        """
        index, mask = estimate.index, mask_file(estimate.mask)
        estimate = replace(estimate, keyframe=self.causal[index].keyframe)
        self.put(FrameRecord.of(estimate, name, self.initial_mask(index), revision=True), mask)
        if self.writes_probabilities:
            write_probability(self._aside, index, estimate.probability)
        return mask

    def put_mask(
        self, index: int, mask: NDArray[np.bool_], probability: NDArray[np.float32] | None = None
    ) -> None:
        """Give a refined estimate another mask, as `put` does; causal ones stand.

        Args:
            index: Index of the frame.
            mask: ``(H, W)``.
            probability: ``(H, W)`` of the object; None if it is written already.

        Raises:
            OutputError: If the probability cannot be written.
        """
        if (record := self._records.get(index)) is None:
            return
        self._records[index] = replace(
            record,
            area=int(np.count_nonzero(mask)),
            iou_initial=mask_iou_or_none(mask, self.initial_mask(index)),
            mask_source=MaskSource.FUSED,
        )
        self._decided[index] = mask_file(mask)
        if probability is not None and self.writes_probabilities:
            write_probability(self._aside, index, probability)


def keep_masks(source: Path, into: Path, index: int) -> None:
    """Take mask and probability of a frame from one folder into another one with ``masks/``.

    Raises:
        OutputError: If it cannot be written.
    """
    with writing(into):
        link_or_copy(layout.mask_path(source, index), layout.mask_path(into, index))
        if (file := layout.probability_path(source, index)).is_file():
            place = layout.probability_path(into, index)
            place.parent.mkdir(exist_ok=True)
            link_or_copy(file, place)


def write_refined(
    into: Path,
    estimate: FrameEstimate,
    frame: Frame,
    causal: FrameRecord,
    initial: NDArray[np.bool_] | None,
    probabilities: bool,
) -> FrameRecord:
    """Write the mask of a refined estimate; its record is to be written by the caller.

    Args:
        into: A folder with ``masks/``.
        estimate: The estimate.
        frame: The frame.
        causal: The frame's causal estimate.
        initial: ``(H, W)`` what the mask tracker gave.
        probabilities: Whether the probabilities of the mask are written, too.

    Raises:
        OutputError: If it cannot be written.
    """
    estimate = replace(
        estimate, refined=True, initial_mask=initial, keyframe=estimate.keyframe or causal.keyframe
    )
    with measure("write") as watch:
        record = FrameRecord.of(estimate, frame.name, initial, revision=True)
        write_mask(layout.mask_path(into, frame.index), estimate.mask)
        if probabilities:
            write_probability(into, frame.index, estimate.probability)
    return record.and_wrote(watch.times.write)
