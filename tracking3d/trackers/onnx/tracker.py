"""Mask tracker ``onnx``: a box tracker gives the region, a segmentation network in an ONNX file the mask."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError, PluginError
from tracking3d.features.networks.store import find_network
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt
from tracking3d.trackers.crops import box_iou, box_of, check_box_in_frame
from tracking3d.trackers.csrt import CsrtTracker
from tracking3d.trackers.first_mask import mask_in_box
from tracking3d.trackers.onnx.boxes import BoxProposer, CsrtBoxes, nano_boxes, vit_boxes
from tracking3d.trackers.onnx.description import SaliencyNetwork, load_segmenter_description
from tracking3d.trackers.onnx.images import TRIAL_BOX, TRIAL_IMAGE, PointSegmenter, Segmenter
from tracking3d.trackers.onnx.judging import ColourJudge, Verdict
from tracking3d.trackers.onnx.promptable import PromptableSegmenter
from tracking3d.trackers.onnx.saliency import SaliencySegmenter
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import ColourSegmentation


class OnnxOptions(Options):
    """Options of ``onnx``."""

    segmenter: str = Field(
        "u2netp", description="Description of inputs and outputs: a built-in name, or a YAML file."
    )
    model: str | None = Field(None, description="Saliency network: ONNX file, or name of a known network.")
    encoder: str | None = Field(None, description="Image encoder: ONNX file or known name.")
    decoder: str | None = Field(None, description="Prompt decoder: ONNX file or known name.")
    box: Literal["csrt", "nano", "vit"] = Field(
        "csrt", description="Box tracker: CSR-DCF, or NanoTrack or VitTrack from ONNX files."
    )
    nano_backbone: str = Field(
        "nanotrack-backbone", description="NanoTrack's backbone: ONNX file, or name of a known network."
    )
    nano_head: str = Field(
        "nanotrack-head", description="NanoTrack's head: ONNX file, or name of a known network."
    )
    vit_model: str = Field(
        "vittrack", description="VitTrack's network: ONNX file, or name of a known network."
    )
    csrt: CsrtTracker.Options = Field(CsrtTracker.Options(), description="Options of CSR-DCF.")
    every: Annotated[int, Field(ge=1, le=1000)] | Literal["auto"] = Field(
        1,
        description="Run the network in every k-th frame, or (auto) if the propagated mask is in doubt, was corrected, "
        "or has moved or changed much; flow propagates the mask in between.",
    )
    crops: tuple[Annotated[float, Field(ge=1, le=4)], ...] = Field(
        (1.2, 1.5), min_length=1, description="Saliency network: factors by which the box is enlarged."
    )
    anchor: bool = Field(True, description="Re-initialize the box tracker on the box of a confident mask.")
    threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")


def build_segmenter(options: OnnxOptions) -> Segmenter:
    """The segmentation network that ``options`` ask for, once it was asked about an image.

    Raises:
        InputError: If a description or a file is missing or cannot be used, or if what it says is no mask.
    """
    description = load_segmenter_description(options.segmenter)

    def file(option: str, given: str | None, default: str | None) -> Path:
        return _file(option, given or default, f"the segmenter '{options.segmenter}'")

    segmenter: Segmenter
    if isinstance(description, SaliencyNetwork):
        model = file("model", options.model, description.model)
        segmenter = SaliencySegmenter(model, description, options.crops, options.threads)
    else:
        encoder = file("encoder", options.encoder, description.encoder_model)
        decoder = file("decoder", options.decoder, description.decoder_model)
        segmenter = PromptableSegmenter(encoder, decoder, description, options.threads)
    segmenter.propose(TRIAL_IMAGE, TRIAL_BOX, None)
    return segmenter


def build_boxes(options: OnnxOptions) -> BoxProposer:
    """The box tracker that ``options`` ask for.

    Raises:
        InputError: If a file is missing or cannot be used.
    """
    match options.box:
        case "nano":
            backbone = _file("nano_backbone", options.nano_backbone, "the box tracker NanoTrack")
            return nano_boxes(backbone, _file("nano_head", options.nano_head, "the box tracker NanoTrack"))
        case "vit":
            return vit_boxes(_file("vit_model", options.vit_model, "the box tracker VitTrack"))
        case _:
            return CsrtBoxes(options.csrt)


def _file(option: str, name: str | None, whose: str) -> Path:
    """The file of a network; errors name the option that gives it."""
    if name is None:
        raise InputError(f"No ONNX file is given for {whose}; set the option tracker.{option}.")
    try:
        return find_network(name)
    except InputError as error:
        raise InputError(f"For {whose} (option tracker.{option}): {error}") from error


_LEAST_SHARPNESS = 0.35  # of a network's mask; below, it has not found anything
_LEAST_AGREEMENT = 0.3  # IoU of the mask's box and the box tracker's
_CONFIDENT = 0.6  # score from which a mask teaches colours and may re-anchor the box
_STRAYED = 0.4  # IoU of the mask's box and the box tracker's, below which the latter is off the object
_PATIENCE = 3  # confident masks in a row that find the box tracker off the object


class OnnxTracker:
    """Mask tracker ``onnx``.

    In every frame the box tracker gives the search region, the network segments there, and the proposed masks are rated
    by colours and by the box, never by the network's own score. The best one is the estimate. A second mask is
    propagated by flow and colours: it is the estimate between the segmented frames, and if the network's masks cannot
    be used. Confident masks re-initialize the box tracker if it has drifted from them.
    """

    Options = OnnxOptions

    def __init__(self, options: OnnxOptions) -> None:
        self._options = options
        self._segmenter = build_segmenter(options)
        self._boxes = build_boxes(options)
        self._carried: ColourSegmentation | None = None
        self._judge: ColourJudge
        self._last_box: Box
        self._schedule = NetworkSchedule(options.every)
        self._strayed = 0

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from its validated options."""
        if not isinstance(options, OnnxOptions):
            raise PluginError("The tracker onnx was given the options of another tracker.")
        return cls(options)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the prompt's mask is the first estimate, else the box's segmentation.

        Raises:
            InputError: If the box lies outside the frame.
        """
        image, box = frame.image, prompt.box
        check_box_in_frame(box, frame)
        estimate = self._first_answer(image, prompt)
        mask = np.zeros(frame.size, np.float32) if estimate.mask is None else estimate.mask
        if prompt.points is not None:
            box = box_of(mask) or box
        self._judge = ColourJudge(image, mask)
        self._carried = ColourSegmentation(image, box, mask > 0.5)
        self._boxes.start(image, box)
        self._last_box, self._strayed = box, 0
        self._schedule.was_run(box_of(mask))
        return estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Estimate the mask in the next frame."""
        if self._carried is None:
            raise PluginError("The tracker onnx must be started with init before it tracks a frame.")
        image = frame.image
        box = self._boxes.update(image)
        carried = self._carried.step(image, box)
        if not self._schedule.is_due(carried, box):
            return carried
        estimate = self._segment(image, box, carried)
        self._schedule.was_run(None if estimate.mask is None else box_of(estimate.mask))
        return estimate

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Re-anchor the box tracker and the carried mask on ``mask`` ``(H, W)`` in ``frame``."""
        box = box_of(mask)
        if box is None or self._carried is None:
            return
        self._carried.correct(frame.image, mask)
        self._judge = self._judge.corrected(frame.image, mask.astype(np.float32))
        self._boxes.start(frame.image, box)
        self._last_box, self._strayed = box, 0
        self._schedule.was_corrected()

    def _first_answer(self, image: Image, prompt: Prompt) -> MaskEstimate:
        if prompt.mask is not None:
            return self._by_points(image, prompt.mask, prompt.points)
        guess = ColourSegmentation(image, prompt.box, mask_in_box(image, prompt.box)).estimate
        if guess.mask is None:
            return guess
        judge = ColourJudge(image, guess.mask)
        best = self._best(judge, image, prompt.box, None, prompt.box)
        if reason := _unusable(best):
            return MaskEstimate(
                mask_in_box(image, prompt.box, warns=True),
                guess.score / 2,
                f"{reason}; the box was segmented by colour instead",
            )
        return MaskEstimate(best.proposal.mask, best.score)

    def _by_points(
        self, image: Image, mask: NDArray[np.bool_], points: NDArray[np.float32] | None
    ) -> MaskEstimate:
        """What the network makes of points, if there are any and it takes them; else the mask that was given."""
        soft = mask.astype(np.float32)
        given = MaskEstimate(soft)
        if points is None or not isinstance(self._segmenter, PointSegmenter):
            return given
        judge = ColourJudge(image, soft)
        verdicts = [
            judge.verdict(image, one, None) for one in self._segmenter.propose_by_points(image, points)
        ]
        best = max(verdicts, key=lambda one: (_count_kept_points(one.proposal.mask, points), one.preference))
        if _unusable(best) or _count_kept_points(best.proposal.mask, points) < _count_kept_points(
            soft, points
        ):
            return given
        return MaskEstimate(best.proposal.mask, best.score)

    def _segment(self, image: Image, tracked_box: Box | None, carried: MaskEstimate) -> MaskEstimate:
        """The network's mask, or the propagated one if the network has no usable mask."""
        assert self._carried is not None
        box = tracked_box if tracked_box is not None else self._place(carried)
        best = self._best(self._judge, image, box, carried.mask, tracked_box)
        if tracked_box is not None and carried.mask is not None and _unusable(best):
            # One of the box tracker and the carried mask is wrong: colours tell whether it is the former.
            other = self._best(self._judge, image, self._place(carried), carried.mask, None)
            if not _unusable(other) and not other.judgement.doubt:
                best, tracked_box = other, None
        if reason := _unusable(best):
            if carried.mask is None:
                return MaskEstimate(None, 0.0, reason)
            return MaskEstimate(carried.mask, carried.score / 2, f"{reason}; the last mask was propagated")
        mask = best.proposal.mask
        self._carried.correct(image, mask > 0.5)
        self._last_box = box_of(mask) or box
        if best.score >= _CONFIDENT:
            self._judge.learn(image, mask)
        if self._options.anchor:
            self._anchor(image, best, tracked_box)
        if tracked_box is None:
            return MaskEstimate(mask, best.score / 2, "the box tracker has lost the object")
        return MaskEstimate(mask, best.score, best.judgement.doubt)

    def _anchor(self, image: Image, best: Verdict, tracked_box: Box | None) -> None:
        """Re-initialize the box tracker if confident masks show that it has left the object, or if it is lost."""
        strayed = tracked_box is None or box_iou(self._last_box, tracked_box) < _STRAYED
        self._strayed = self._strayed + 1 if strayed and best.score_without_box >= _CONFIDENT else 0
        if self._strayed >= (1 if tracked_box is None else _PATIENCE):
            self._boxes.start(image, self._last_box)
            self._strayed = 0

    def _best(
        self,
        judge: ColourJudge,
        image: Image,
        box: Box,
        last: NDArray[np.float32] | None,
        tracked_box: Box | None,
    ) -> Verdict:
        proposals = self._segmenter.propose(image, box, last)
        verdicts = [judge.verdict(image, proposal, tracked_box) for proposal in proposals]
        return max(verdicts, key=lambda verdict: verdict.preference)

    def _place(self, carried: MaskEstimate) -> Box:
        """Where to look while the box tracker is lost."""
        found = None if carried.mask is None else box_of(carried.mask)
        return self._last_box if found is None else found


def _count_kept_points(mask: NDArray[np.float32], points: NDArray[np.float32]) -> int:
    """How many of the points a mask keeps to."""
    x, y = np.rint(points[:, :2]).astype(int).T
    inside = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)] > 0.5
    return int(np.count_nonzero(inside == (points[:, 2] > 0)))


def _unusable(verdict: Verdict) -> str:
    """Why a mask cannot be the estimate, or empty."""
    if box_of(verdict.proposal.mask) is None:
        return "the network found no object"
    if verdict.proposal.sharpness < _LEAST_SHARPNESS:
        return "the network's mask is blurred"
    agreement = verdict.judgement.agreement
    return "" if agreement is None or agreement >= _LEAST_AGREEMENT else verdict.judgement.doubt


_LONGEST = 6  # frames without a new mask of the network
_DROPPED = 0.85  # of the score right after the network's mask
_CHANGED = 0.7  # IoU with the box of the network's mask, moved to the same centre
_APART = 0.1  # drop of the IoU of the mask's box and the box tracker's


@dataclass
class NetworkSchedule:
    """Decides in which frames the network is run."""

    # it is run in every k-th frame; auto: if something has changed since its last mask, and in every sixth
    # frame
    every: int | Literal["auto"]
    _frames: int = 0
    _size: Box | None = None
    _score: float | None = None
    _agreement: float | None = None
    _corrected: bool = False

    def is_due(self, carried: MaskEstimate, box: Box | None) -> bool:
        """Whether the network is to be run in the present frame.

        Args:
            carried: The propagated mask.
            box: ``(x, y, w, h)`` of the box tracker; None if it has lost the object.
        """
        self._frames += 1
        if carried.reason or carried.mask is None:
            return True
        if self.every != "auto":
            return self._frames >= self.every
        found = box_of(carried.mask)
        if found is None or box is None or self._corrected or self._frames >= _LONGEST:
            return True
        agreement = box_iou(found, box)
        if self._score is None or self._agreement is None:  # the first mask that was propagated
            self._score, self._agreement = carried.score, agreement
        changed = self._size is None or _same_size(found, self._size) < _CHANGED
        return changed or carried.score < _DROPPED * self._score or agreement < self._agreement - _APART

    def was_run(self, box: Box | None) -> None:
        """Begin again after a mask of the network.

        Args:
            box: ``(x, y, w, h)`` of that mask.
        """
        self._frames, self._corrected = 0, False
        self._size, self._score, self._agreement = box, None, None

    def was_corrected(self) -> None:
        """Take note that the solver has disagreed with the last mask."""
        self._corrected = True


def _same_size(one: Box, other: Box) -> float:
    """IoU of two boxes that are moved to the same centre."""
    return box_iou((-one[2] / 2, -one[3] / 2, *one[2:]), (-other[2] / 2, -other[3] / 2, *other[2:]))
