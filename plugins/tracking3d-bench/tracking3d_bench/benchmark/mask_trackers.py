"""Mask trackers by themselves: how good their masks are, how long they take, what their scores are worth.

No pose is estimated. Masks are compared with the visible part of the object, if the data have it, since a mask
tracker sees no more.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError, Tracking3dError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.plugins import TRACKERS, build_plugin, check_options, plugin_label
from tracking3d.plugins.guard import GuardedTracker
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video.image_file import read_image
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.layout import load_layout
from tracking3d_bench.datasets.reading import read_sequence
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.calibration import area_under_roc
from tracking3d_bench.evaluation.mask_scores import compare_masks

Start = Literal["box", "mask"]

FLOW_CUES: Mapping[str, Mapping[str, Any]] = {
    "no prior": {"prior": 0.0},
    "no outline": {"outline": 0.0},
    "no similarity": {"similarity": False},
    "no global colours": {"global_colours": 0.0},
    "no local colours": {"local_colours": 0.0},
    "no motion": {"motion": 0.0},
    "no background": {"background": 0.0},
    "no novelty": {"novelty": 0.0},
    "no smoother": {"smoother": False},
    "no witness": {"witness": "none"},
}
"""The options that switch each cue of the tracker ``flow`` off."""


@dataclass(frozen=True)
class Contestant:
    """A mask tracker and what tables call it."""

    label: str  # its name in tables
    choice: PluginChoice  # the plug-in and its options

    @classmethod
    def of(cls, choice: PluginChoice) -> Self:
        """Called by its name and the options that were given."""
        return cls(" ".join([choice.name, *(f"{k}={v}" for k, v in choice.options.items())]), choice)


@dataclass(frozen=True)
class TrackedFrame:
    """One frame after the first that has a true mask or box."""

    index: int  # its index in the sequence
    iou: float  # IoU of the tracker's mask and the true one; no mask is an empty one
    boundary_f: float  # boundary F of the same; NaN if only a box is known
    score: float  # the tracker's own


@dataclass(frozen=True)
class TrackerMeasurement:
    """One tracker on one sequence, or on several together."""

    tracker: str  # the contestant's label
    sequence: str  # the sequence's name
    frames: tuple[TrackedFrame, ...] = ()  # every frame that was scored
    # wall time of every step, scored or not; the first frame is not among them
    seconds: tuple[float, ...] = ()
    error: str = ""  # why it failed, or empty

    def figures(self) -> dict[str, float | int | None]:
        """The measures by name; None if there is nothing to measure.

        ``iou_mean``, ``boundary_f_mean``, ``share_under_half`` (of frames with an IoU under 0.5),
        ``milliseconds`` (median of a frame), ``auc_50`` and ``auc_70`` (area under the ROC curve of the score as
        a sign of an IoU of at least 0.5 and 0.7), ``frames_scored``.
        """
        ious, boundaries, scores = (
            np.array([getattr(frame, name) for frame in self.frames])
            for name in ("iou", "boundary_f", "score")
        )
        return {
            "iou_mean": _mean(ious),
            "boundary_f_mean": _mean(boundaries),
            "share_under_half": _mean(ious < 0.5),
            "milliseconds": 1000 * float(np.median(self.seconds)) if self.seconds else None,
            "auc_50": area_under_roc(scores, ious >= 0.5),
            "auc_70": area_under_roc(scores, ious >= 0.7),
            "frames_scored": len(ious),
        }


def measure_trackers(
    contestants: Sequence[Contestant],
    dataset: Dataset,
    start: Start = "box",
    most_frames: int | None = None,
    listener: Callable[[TrackerMeasurement], None] = lambda measured: None,
) -> list[TrackerMeasurement]:
    """Every tracker on every sequence, one after the other, so that the times mean something.

    Args:
        contestants: The trackers.
        dataset: The sequences.
        start: Whether trackers start from the first frame's box or from its true mask.
        most_frames: Only so many frames of each sequence.
        listener: Called for every result.
    """
    results = []
    for contestant in contestants:
        for sequence in dataset.sequences:
            results.append(_measure(contestant, dataset, sequence, start, most_frames))
            listener(results[-1])
    return results


def ablation(contestant: Contestant) -> list[Contestant]:
    """The contestant, and it with each of the cues of ``flow`` that are on switched off in turn.

    Raises:
        InputError: If it is not the tracker ``flow``.
    """
    if contestant.choice.name != "flow":
        raise InputError(
            f"The tracker '{contestant.choice.name}' has no cues to switch off; use --tracker flow."
        )
    given = contestant.choice.model_dump()
    options = check_options(TRACKERS, contestant.choice).model_dump()
    return [contestant] + [
        Contestant(f"{contestant.label}, {label}", PluginChoice.model_validate({**given, **off}))
        for label, off in FLOW_CUES.items()
        if any(options[name] != value for name, value in off.items())
    ]


def overall(results: Sequence[TrackerMeasurement]) -> dict[str, dict[str, float | int | None]]:
    """Figures by tracker: means over its sequences; areas and times over all of its frames together."""
    figures = {}
    for tracker in dict.fromkeys(one.tracker for one in results):
        done = [one for one in results if one.tracker == tracker and not one.error]
        frames = tuple(frame for one in done for frame in one.frames)
        seconds = tuple(second for one in done for second in one.seconds)
        pooled = TrackerMeasurement(tracker, "all", frames, seconds).figures()
        means = {
            name: _mean([figure for one in done if (figure := one.figures()[name]) is not None])
            for name in ("iou_mean", "boundary_f_mean", "share_under_half")
        }
        figures[tracker] = {**pooled, **means}
    return figures


def track_masks(
    choice: PluginChoice, truth: Truth, start: Start = "box"
) -> Iterator[tuple[Frame, MaskEstimate, float]]:
    """Send a sequence through a mask tracker; yields each frame, the estimate and the seconds it took.

    Raises:
        InputError: If the sequence cannot be read or has no prompt.
        PluginError: If the tracker is unknown, its options are not its own, or it fails.
    """
    tracker = GuardedTracker(build_plugin(TRACKERS, choice), plugin_label(TRACKERS, choice.name))
    for index, path in enumerate(truth.frames):
        frame = Frame(index, read_image(path), name=path.name)
        prompt = _prompt(truth, frame, start) if index == 0 else None
        began = time.perf_counter()
        estimate = tracker.step(frame) if prompt is None else tracker.init(frame, prompt)
        yield frame, estimate, time.perf_counter() - began


def _measure(
    contestant: Contestant, dataset: Dataset, sequence: str, start: Start, most_frames: int | None
) -> TrackerMeasurement:
    measured = TrackerMeasurement(contestant.label, sequence)
    frames, seconds = [], []
    try:
        truth = _visible_truth(read_sequence(load_layout(dataset.layout), dataset.root, sequence))
        for frame, estimate, took in islice(track_masks(contestant.choice, truth, start), most_frames):
            if frame.index:
                seconds.append(took)
                frames += _compare(frame, estimate, truth)
    except Tracking3dError as error:
        return replace(measured, error=str(error))
    if not frames:
        return replace(measured, error="No frame after the first has a true mask or box.")
    return replace(measured, frames=tuple(frames), seconds=tuple(seconds))


def _visible_truth(truth: Truth) -> Truth:
    return replace(truth, masks={**truth.masks, **truth.visible_masks})


def _prompt(truth: Truth, frame: Frame, start: Start) -> Prompt:
    if start == "mask":
        if 0 not in truth.masks:
            raise InputError(f"{truth.name} has no true mask of its first frame; use --start box.")
        return make_prompt(frame, mask=truth.masks[0].read())
    if truth.box is None:
        raise InputError(f"{truth.name} has no box in its first frame; a mask tracker cannot start.")
    return make_prompt(frame, box=truth.box_in_frame())


@dataclass(frozen=True, eq=False)
class _MaskInMemory:
    mask: NDArray[np.bool_]

    def read(self) -> NDArray[np.bool_]:
        return self.mask


def _compare(frame: Frame, estimate: MaskEstimate, truth: Truth) -> list[TrackedFrame]:
    """The frame's figures; none if the ground truth is unknown."""
    masks = {} if estimate.binary is None else {frame.index: _MaskInMemory(estimate.binary)}
    here = range(frame.index, frame.index + 1)
    compared = compare_masks(Answers(truth.frames[0].parent, here, frozenset(here), masks=masks), truth)
    return [
        TrackedFrame(index, masks.iou, masks.boundary_f, float(estimate.score))
        for index, masks in compared.items()
    ]


def _mean(values: ArrayLike) -> float | None:
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else None
