"""How much a pose may say about a mask, given its confidence."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.estimation.segmentation.pose_weight import (
    blend_with_initial,
    pose_weight,
    relative_confidence,
)
from tracking3d.frames import TRACKED_CONFIDENCE


def test_a_pose_that_is_as_likely_wrong_as_right_redraws_nothing():
    assert pose_weight(0.0) == pose_weight(0.5) == 0
    assert 0 < pose_weight(0.6) < pose_weight(0.7) < 1
    assert pose_weight(TRACKED_CONFIDENCE) == pose_weight(1.0) == 1


def test_the_relative_confidence_is_one_half_where_a_frame_just_counts_as_tracked():
    assert relative_confidence(TRACKED_CONFIDENCE) == pytest.approx(0.5)
    assert relative_confidence(0.0) == 0 and relative_confidence(1.0) == 1
    odds = [
        relative_confidence(one) / (1 - relative_confidence(one)) * (1 - one) / one
        for one in (0.1, 0.5, 0.95)
    ]
    assert odds == pytest.approx([(1 - TRACKED_CONFIDENCE) / TRACKED_CONFIDENCE] * 3)


def test_with_full_weight_the_evidence_decides_alone_and_without_any_the_initial_mask_does():
    odds = np.array([[3.0, -3.0]], np.float32)
    initial = np.array([[False, True]])
    assert np.array_equal(blend_with_initial(odds, initial, 1.0), odds)
    assert np.array_equal(blend_with_initial(odds, initial, 0.0) > 0, initial)
