"""Uncertain and lost frames in a row are one range, whatever their reasons."""

from __future__ import annotations

import pytest
from recorded_runs import estimate_of

from tracking3d.estimation.estimate import Status
from tracking3d.results.records import FrameRecord
from tracking3d.ui.sentences import DoubtfulRange, doubtful_ranges


def record(index: int, status: Status, reason: str = "") -> FrameRecord:
    return FrameRecord.of(estimate_of(index, status, reason))


def test_a_range_ends_where_the_status_changes_and_not_where_a_reason_does():
    records = [
        record(0, Status.TRACKED),
        record(5, Status.LOST, "loss 0.31"),
        record(6, Status.LOST, "loss 0.78"),
        record(7, Status.UNCERTAIN, "loss 0.2"),
        record(9, Status.UNCERTAIN, "gone"),
        record(11, Status.UNCERTAIN, "loss 0.4"),
        record(12, Status.TRACKED),
        record(13, Status.LOST),
    ]
    assert doubtful_ranges(records) == [
        DoubtfulRange(1, 5, 6, 2, Status.LOST, "loss 0.31"),
        DoubtfulRange(3, 7, 11, 3, Status.UNCERTAIN, "loss 0.2, 2 frames; gone, 1 frame"),
        DoubtfulRange(7, 13, 13, 1, Status.LOST, ""),
    ]


@pytest.mark.parametrize("records", [[], [record(0, Status.TRACKED)]], ids=["none", "tracked"])
def test_where_nothing_is_doubtful_there_is_no_range(records):
    assert doubtful_ranges(records) == []
