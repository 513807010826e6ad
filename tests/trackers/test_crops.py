"""What lies outside a box."""

from __future__ import annotations

import numpy as np

from tracking3d.trackers.crops import outside


def test_pixels_are_outside_where_their_centres_are() -> None:
    beside = outside((2.0, 1.0, 3.0, 2.0), (6, 8, 3))
    assert beside.shape == (6, 8)
    inside = np.zeros((6, 8), bool)
    inside[1:3, 2:5] = True
    np.testing.assert_array_equal(beside, ~inside)


def test_slack_grows_the_box_by_a_share_of_each_side() -> None:
    inside = ~outside((10.0, 10.0, 20.0, 10.0), (40, 50), 0.1)
    rows, columns = np.nonzero(inside)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (9, 20, 8, 31)


def test_a_box_that_holds_the_frame_leaves_nothing_outside() -> None:
    assert not outside((-1.0, -1.0, 30.0, 30.0), (20, 20)).any()
