"""Scores of a method's self-assessment: calibration of its confidence, and its frames with status ``lost``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from tracking3d.estimation.online.features.klt import texture_strength
from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.calibration import (
    area_under_roc,
    detection_scores,
    expected_calibration_error,
)
from tracking3d_bench.evaluation.mask_scores import FrameMasks
from tracking3d_bench.evaluation.vot import LongTermScores, LongTermSequence, long_term_scores

RIGHT_ROTATION, RIGHT_IOU = 10.0, 0.7
"""A frame is right below this rotation error in degrees and above this IoU, if they are known."""

LOST_ROTATION, LOST_IOU = 30.0, 0.3
"""A frame is truly lost above this rotation error in degrees or below this IoU."""

_USUAL_TEXTURE = 4.0  # strength of a printed thing in good light; real ones have 3 and more
_TEXTURES = 0.25, 16.0  # strengths beyond which it counts no further
_USUAL_MOTION = 10.0  # degrees a frame that count as a halving of the texture does


@dataclass(frozen=True, kw_only=True)
class ConfidenceScores:
    """Self-assessment over the frames with a true pose or mask; the given frame aside.

    A frame is right with a rotation error under 10 degrees and an IoU over 0.7, as far as the truth is known, and
    truly lost with a rotation error over 30 degrees or an IoU under 0.3.

    Attributes:
        confidence_calibration_error: Expected calibration error of the confidence; None without confidences.
        confidence_auc: Probability that a right frame has a higher confidence than a wrong one, ties for a half; None
            if all are right or all wrong.
        lost_precision: Share of the frames called lost that truly are; None if none was called so.
        lost_recall: Share of the truly lost frames that were called so; None if there is none.
        frames_truly_lost: Number of truly lost frames.
        vot_precision, vot_recall, vot_f_score: VOT's long-term measures of this clip alone, at the confidence with
            the largest F; the given frame counts as VOT counts it, with overlap and confidence 0.
    """

    confidence_calibration_error: float | None = None
    confidence_auc: float | None = None
    lost_precision: float | None = None
    lost_recall: float | None = None
    frames_truly_lost: int = 0
    vot_precision: float | None = None
    vot_recall: float | None = None
    vot_f_score: float | None = None


def right_frames(
    answers: Answers, rotation: Mapping[int, float], masks: Mapping[int, FrameMasks]
) -> dict[int, bool]:
    """Whether each frame whose truth is known is right; the given frame aside.

    Args:
        answers: The method's results.
        rotation: Rotation error in degrees by frame.
        masks: Estimated and true masks, by frame.
    """
    return {
        n: rotation.get(n, 0.0) < RIGHT_ROTATION and (n not in masks or masks[n].iou > RIGHT_IOU)
        for n in sorted((rotation.keys() | masks.keys()) - {answers.given})
    }


def frame_difficulties(truth: Truth) -> dict[int, float]:
    """How hard each frame with a known pose is, without any method's results: the calibration is told by it.

    The sum of three numbers: how often the texture strength has been halved from that of a printed thing, the
    share of the object that is hidden, in quarters, and the rotation since the frame before, in tens of degrees.
    A number that is not known is 0. It was chosen before any calibration was measured by it, and fitted to nothing.
    """
    found = {}
    for n in sorted(truth.T_cam_obj):
        hard = 0.0
        visible = truth.visible_masks.get(n, truth.masks.get(n))
        if visible is not None:
            seen = visible.read()
            strength = texture_strength(cv2.cvtColor(read_image(truth.frames[n]), cv2.COLOR_RGB2GRAY), seen)
            hard += math.log2(_USUAL_TEXTURE / min(max(strength, _TEXTURES[0]), _TEXTURES[1]))
            whole = int(truth.masks[n].read().sum()) if n in truth.masks else 0
            hard += 4 * max(0.0, 1 - float(seen.sum()) / whole) if whole else 0.0
        if n - 1 in truth.T_cam_obj:
            turn = truth.T_cam_obj[n][:3, :3] @ truth.T_cam_obj[n - 1][:3, :3].T
            cosine = (np.trace(turn) - 1) / 2
            hard += math.degrees(math.acos(min(max(cosine, -1.0), 1.0))) / _USUAL_MOTION
        found[n] = hard
    return found


def score_confidence(
    answers: Answers, rotation: Mapping[int, float], masks: Mapping[int, FrameMasks]
) -> ConfidenceScores:
    """Judge the self-assessment.

    Args:
        answers: The method's results.
        rotation: Rotation error in degrees by frame.
        masks: Estimated and true masks, by frame.
    """
    by_frame = right_frames(answers, rotation, masks)
    if not by_frame:
        return ConfidenceScores()
    frames, right = list(by_frame), np.array(list(by_frame.values()))
    errors = np.array([rotation.get(n, 0.0) for n in frames])
    ious = np.array([masks[n].iou if n in masks else 1.0 for n in frames])
    lost = (errors > LOST_ROTATION) | (ious < LOST_IOU)
    # Saying nothing of a frame is a way to say that it is lost.
    called = np.array([n in answers.lost or n not in answers.answered for n in frames])
    detection = detection_scores(called, lost)
    said = np.array([n in answers.confidence for n in frames])
    confidence = np.array([answers.confidence[n] for n in frames if n in answers.confidence])
    long_term = _long_term(answers, masks)
    return ConfidenceScores(
        confidence_calibration_error=expected_calibration_error(confidence, right[said]),
        confidence_auc=area_under_roc(confidence, right[said]),
        lost_precision=detection.precision,
        lost_recall=detection.recall,
        frames_truly_lost=int(lost.sum()),
        vot_precision=long_term.precision if long_term else None,
        vot_recall=long_term.recall if long_term else None,
        vot_f_score=long_term.f_score if long_term else None,
    )


def _long_term(answers: Answers, masks: Mapping[int, FrameMasks]) -> LongTermScores | None:
    if not masks or not answers.confidence:
        return None
    given = answers.given
    return long_term_scores(
        [
            LongTermSequence(
                overlaps=[0.0 if n == given else one.iou for n, one in masks.items()],
                confidence=[0.0 if n == given else answers.confidence.get(n, 0.0) for n in masks],
                visible=[one.visible for one in masks.values()],
            )
        ]
    )
