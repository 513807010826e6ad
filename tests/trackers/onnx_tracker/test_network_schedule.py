"""In which frames a segmentation network is run."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.frames import MaskEstimate
from tracking3d.trackers.onnx.tracker import NetworkSchedule

BOX = (20.0, 20.0, 40.0, 30.0)


def carried(score: float = 0.9, reason: str = "", width: int = 40) -> MaskEstimate:
    mask = np.zeros((90, 120), np.float32)
    mask[20:50, 20 : 20 + width] = 1
    return MaskEstimate(mask, score, reason)


def begun(every: int | str) -> NetworkSchedule:
    """Right after a mask of the network, and one propagated frame."""
    schedule = NetworkSchedule(every)
    schedule.was_run(BOX)
    assert not schedule.is_due(carried(), BOX)
    return schedule


def test_every_third_frame():
    schedule = NetworkSchedule(3)
    asked = []
    for _ in range(9):
        asked.append(schedule.is_due(carried(), BOX))
        if asked[-1]:
            schedule.was_run(BOX)
    assert asked == [False, False, True] * 3


@pytest.mark.parametrize("every", [5, "auto"])
def test_a_doubtful_mask_is_segmented_before_its_turn(every):
    assert begun(every).is_due(carried(reason="the area has changed"), BOX)
    assert begun(every).is_due(MaskEstimate(None, 0.0, "the object is not visible"), BOX)


def test_what_stays_as_it_was_is_propagated_for_five_frames():
    schedule = begun("auto")
    assert [schedule.is_due(carried(), BOX) for _ in range(5)] == [False] * 4 + [True]


def test_a_falling_score_a_new_size_and_a_box_elsewhere_ask_for_the_network():
    assert begun("auto").is_due(carried(score=0.7), BOX)
    assert begun("auto").is_due(carried(width=24), BOX)
    assert begun("auto").is_due(carried(), (28.0, 20.0, 40.0, 30.0))
    assert begun("auto").is_due(carried(), None)
    assert not begun("auto").is_due(carried(score=0.88, width=38), (21.0, 20.0, 40.0, 30.0))


def test_a_correction_asks_for_the_network_and_a_new_mask_settles_it():
    schedule = begun("auto")
    schedule.was_corrected()
    assert schedule.is_due(carried(), BOX)
    schedule.was_run(BOX)
    assert not schedule.is_due(carried(), BOX)
