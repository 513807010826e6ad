"""Scores of masks, against ground truth and compared with the initial masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.trackers.crops import box_of
from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.truth import MaskReference, Truth
from tracking3d_bench.evaluation.boundary import boundary_f
from tracking3d_bench.evaluation.metrics import mask_iou
from tracking3d_bench.evaluation.vot import rectangle_overlap

Mask = NDArray[np.bool_]
_EQUAL = 1e-9


@dataclass(frozen=True, kw_only=True)
class MaskScores:
    """Masks over the frames with a true mask or box, except the one that the method was given.

    All are None if there is no such frame. If only boxes are known, the box around a mask is compared, and
    there is no boundary.

    Attributes:
        iou_initial_mean: Mean IoU of the mask tracker's masks.
        iou_mean: Mean IoU of the estimates.
        iou_gain_percent: How much larger `iou_mean` is than `iou_initial_mean`.
        share_own_masks: Share of frames whose estimate is not the unchanged initial mask; a missing estimate counts as
            unchanged.
            None if the origin of masks was not recorded.
        share_worse_than_initial: Share of frames where the estimate's IoU is the smaller one by more than 1e-9.
        boundary_f_initial_mean: Mean boundary F of the mask tracker's masks.
        boundary_f_mean: Mean boundary F of the estimates.
        davis_j_mean, davis_f_mean: IoU and boundary F as DAVIS takes them, without the last frame too.
        frames_with_mask: Number of the frames that the first four are means of.
    """

    iou_initial_mean: float | None = None
    iou_mean: float | None = None
    iou_gain_percent: float | None = None
    share_own_masks: float | None = None
    share_worse_than_initial: float | None = None
    boundary_f_initial_mean: float | None = None
    boundary_f_mean: float | None = None
    davis_j_mean: float | None = None
    davis_f_mean: float | None = None
    frames_with_mask: int = 0


@dataclass(frozen=True)
class FrameMasks:
    """One frame's masks against the true one; NaN without a true boundary.

    In a frame with an estimate, no mask is an empty one; in one without, everything is 0.

    Attributes:
        iou: IoU of the estimate.
        iou_initial: IoU of the mask tracker's mask.
        boundary_f: Boundary F of the estimate.
        boundary_f_initial: Boundary F of the mask tracker's mask.
        visible: Whether the truth shows the object at all.
    """

    iou: float
    iou_initial: float
    boundary_f: float
    boundary_f_initial: float
    visible: bool


def compare_masks(answers: Answers, truth: Truth) -> dict[int, FrameMasks]:
    """The masks of every frame that was asked for and has a true mask or box; none if the method gives no masks.

    Raises:
        InputError: If a mask cannot be read or has not the size of the true one.
    """
    if answers.masks is None:
        return {}
    return {n: _compare(answers, truth, n) for n in answers.asked if n in truth.masks or n in truth.boxes}


def score_masks(compared: Mapping[int, FrameMasks], answers: Answers, truth: Truth) -> MaskScores:
    """Score what `compare_masks` found; the frame whose mask the method was given does not count."""
    scored = {n: masks for n, masks in compared.items() if n != answers.given}
    if not scored:
        return MaskScores()
    values = np.array([astuple(masks)[:4] for masks in scored.values()])
    answer, initial, f_answer, f_initial = (_mean(column) for column in values.T)
    started = answers.initial_masks is not None
    before_last = np.array(list(scored)) != len(truth.frames) - 1
    return MaskScores(
        iou_initial_mean=initial if started else None,
        iou_mean=answer,
        iou_gain_percent=100 * (answer / initial - 1) if started and answer is not None and initial else None,
        share_own_masks=_share_own(answers, list(scored)),
        share_worse_than_initial=float(np.mean(values[:, 0] < values[:, 1] - _EQUAL)) if started else None,
        boundary_f_initial_mean=f_initial if started else None,
        boundary_f_mean=f_answer,
        davis_j_mean=_mean(values[before_last, 0]),
        davis_f_mean=_mean(values[before_last, 2]),
        frames_with_mask=len(scored),
    )


def _share_own(answers: Answers, frames: list[int]) -> float | None:
    answered = [n for n in frames if n in answers.answered]
    if not answered or not all(n in answers.mask_sources for n in answered):
        return None
    return sum(answers.mask_sources[n].is_own for n in answered) / len(frames)


def _compare(answers: Answers, truth: Truth, index: int) -> FrameMasks:
    estimated = answers.masks
    if truth.is_visible_part(index) and answers.visible_masks is not None:
        estimated = answers.visible_masks
    masks = [_read_mask(references, index) for references in (estimated, answers.initial_masks)]
    if index in answers.answered:  # no mask is an empty one: it says that the object is nowhere
        masks = [np.zeros(_size(truth, index), bool) if mask is None else mask for mask in masks]
    if index not in truth.masks:
        true_box = truth.boxes[index]
        ious = [0.0 if mask is None else _box_iou(mask, true_box) for mask in masks]
        return FrameMasks(ious[0], ious[1], np.nan, np.nan, bool(true_box[2] * true_box[3] > 0))
    true = truth.masks[index].read()
    for mask in masks:
        if mask is not None and mask.shape != true.shape:
            raise InputError(
                f"Frame {index}: the mask of {answers.origin} is {mask.shape[1]} x {mask.shape[0]} pixels "
                f"and the true one of {truth.name} {true.shape[1]} x {true.shape[0]}; give the clip of the "
                "run."
            )
    ious = [0.0 if mask is None else mask_iou(mask, true) for mask in masks]
    if truth.boxes:  # true masks next to boxes are empty: they say nothing about boundaries
        return FrameMasks(ious[0], ious[1], np.nan, np.nan, bool(true.any()))
    boundaries = [0.0 if mask is None else boundary_f(mask, true) for mask in masks]
    return FrameMasks(ious[0], ious[1], boundaries[0], boundaries[1], bool(true.any()))


def _box_iou(mask: Mask, true_box: Box) -> float:
    """IoU of the box around a mask and the true one, in whole pixels as VOT takes it."""
    box = box_of(mask) or (0.0, 0.0, 0.0, 0.0)
    return rectangle_overlap(box, true_box, (mask.shape[1], mask.shape[0]))


def _size(truth: Truth, index: int) -> tuple[int, int]:
    height, width = (
        truth.masks[index].read() if index in truth.masks else read_image(truth.frames[index])
    ).shape[:2]
    return height, width


def _read_mask(references: Mapping[int, MaskReference] | None, index: int) -> Mask | None:
    return references[index].read() if references and index in references else None


def _mean(values: NDArray[np.float64]) -> float | None:
    """Mean of what is known; None if nothing is."""
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
