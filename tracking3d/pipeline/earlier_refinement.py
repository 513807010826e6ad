"""What of a run's final refinement stands after a correction: frames whose causal estimates did not change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tracking3d.errors import InputError
from tracking3d.estimation.refined_start import LEAST_FRAMES, RefinedStart
from tracking3d.results import layout
from tracking3d.results.files import read_mask
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import load_own_model, read_own_records
from tracking3d.segmentation.temporal_neighbours import REACH

_LEAST_SHARE = 0.5
"""Of the frames; if fewer keep their estimates, the whole video is refined again."""
_ROUNDING = 1e-6  # by which poses of equal estimates differ


@dataclass(frozen=True, eq=False)
class EarlierRefinement:
    """The refined estimates that stand."""

    folder: Path  # the run folder that they are in
    start: RefinedStart  # their poses, and the surface
    kept: Mapping[int, FrameRecord]  # their records by frame index
    changed: tuple[int, ...]  # indices of the other frames, ascending

    @cached_property
    def near(self) -> frozenset[int]:
        """The frames whose masks are decided again: those that changed, and those in whose motion cue they are."""
        order = sorted((*self.kept, *self.changed))
        place = {index: at for at, index in enumerate(order)}
        return frozenset(
            order[at]
            for index in self.changed
            for at in range(max(place[index] - REACH, 0), min(place[index] + REACH + 1, len(order)))
        )


def find_earlier_refinement(
    folder: Path, stage: Path, causal: Mapping[int, FrameRecord]
) -> EarlierRefinement | None:
    """What stands of the final refinement of a run that is being corrected; None if that is too little.

    Args:
        folder: The run as it was before the correction.
        stage: The corrected run, with causal estimates so far.
        causal: These, by frame index.
    """
    try:
        run, before = RunReader(folder), RunReader(folder, refined=False)
        refined = {one.index: one for one in read_own_records(run) if one.refined}
        earlier = {one.index: one for one in read_own_records(before)}
        online = folder / layout.ONLINE
        model = load_own_model(run, online if (online / layout.FEATURES).is_file() else folder)
        camera = run.camera
    except InputError:  # there is no refined mesh, or the run is damaged
        return None
    kept = {
        index: refined[index]
        for index, one in causal.items()
        if index in refined and index in earlier
        and _equal(one, earlier[index]) and _same_masks(stage, before, index)
        and np.isfinite(refined[index].T_cam_obj).all()
    }  # fmt: skip
    if len(kept) < max(LEAST_FRAMES, _LEAST_SHARE * len(causal)):
        return None
    start = RefinedStart(
        camera,
        np.asarray(model.vertices, np.float64),
        {index: one.T_cam_obj for index, one in kept.items()},
        {index: causal[index].T_cam_obj for index in kept},
        {index: causal[index].through(camera).fx for index in kept},
    )
    changed = tuple(sorted(causal.keys() - kept.keys()))
    return EarlierRefinement(folder, start, kept, changed)


def _equal(one: FrameRecord, other: FrameRecord) -> bool:
    same = (one.status, one.camera is None) == (other.status, other.camera is None)
    cameras = one.camera is None or np.allclose(one.camera, other.camera or 0)
    return bool(
        same and cameras and np.allclose(one.T_cam_obj, other.T_cam_obj, rtol=_ROUNDING, atol=_ROUNDING)
    )


def _same_masks(stage: Path, before: RunReader, index: int) -> bool:
    """Whether estimated and initial mask of a frame are what they were."""
    pairs = (
        (layout.mask_path(stage, index), before.mask_path(index)),
        (layout.initial_mask_path(stage, index), layout.initial_mask_path(before.folder, index)),
    )
    return all(_equal_masks(one, other) for one, other in pairs)


def _equal_masks(one: Path, other: Path) -> bool:
    try:
        if one.samefile(other):
            return True
    except OSError:
        return not one.exists() and not other.exists()
    first, second = read_mask(one), read_mask(other)
    return first is not None and second is not None and np.array_equal(first, second)
