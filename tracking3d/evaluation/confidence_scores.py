"""Does the method know when it is wrong? Calibration of its confidence, and its calls of ``lost``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracking3d.datasets.answers import Answers
from tracking3d.evaluation.calibration import detection_scores, expected_calibration_error

RIGHT_ROTATION, RIGHT_IOU = 10.0, 0.7
"""A frame is right below this rotation error in degrees and above this IoU, where they are known."""

LOST_ROTATION, LOST_IOU = 30.0, 0.3
"""A frame is truly lost above this rotation error in degrees or below this IoU."""


@dataclass(frozen=True, kw_only=True)
class ConfidenceScores:
    """Self-assessment over the frames with a true pose or mask; the given frame aside.

    A frame is right with a rotation error under 10 degrees and an IoU over 0.7, as far as the truth is known, and
    truly lost with a rotation error over 30 degrees or an IoU under 0.3.

    Attributes:
        confidence_calibration_error: Expected calibration error of the confidence; None without confidences.
        lost_precision: Share of the frames called lost that truly are; None if none was called so.
        lost_recall: Share of the truly lost frames that were called so; None if there is none.
        frames_truly_lost: Number of truly lost frames.
    """

    confidence_calibration_error: float | None = None
    lost_precision: float | None = None
    lost_recall: float | None = None
    frames_truly_lost: int = 0


def score_confidence(answers: Answers, rotation: dict[int, float], iou: dict[int, float]) -> ConfidenceScores:
    """Judge the self-assessment.

    Args:
        answers: The method's.
        rotation: Rotation error in degrees by frame.
        iou: IoU of the answer by frame.
    """
    frames = sorted((rotation.keys() | iou.keys()) - {answers.given})
    if not frames:
        return ConfidenceScores()
    errors = np.array([rotation.get(n, 0.0) for n in frames])
    ious = np.array([iou.get(n, 1.0) for n in frames])
    right = (errors < RIGHT_ROTATION) & (ious > RIGHT_IOU)
    lost = (errors > LOST_ROTATION) | (ious < LOST_IOU)
    # Saying nothing of a frame is a way to say that it is lost.
    called = np.array([n in answers.lost or n not in answers.answered for n in frames])
    detection = detection_scores(called, lost)
    said = np.array([n in answers.confidence for n in frames])
    confidence = np.array([answers.confidence[n] for n in frames if n in answers.confidence])
    return ConfidenceScores(
        confidence_calibration_error=expected_calibration_error(confidence, right[said]),
        lost_precision=detection.precision,
        lost_recall=detection.recall,
        frames_truly_lost=int(lost.sum()),
    )
