"""When what moves along beside the object may be new of it."""

from __future__ import annotations

import pytest
from solid_points import map_with_points

from tracking3d.estimation.online.moving import seen_again


@pytest.mark.parametrize(
    ("shown", "turned_to", "again"),
    [
        ([0.0, 20.0, 40.0], 0, True),  # it has turned away by 40 degrees and is back
        ([0.0, 20.0, 40.0], 1, False),  # 20 degrees away only
        ([0.0, 20.0, 40.0], 2, False),  # where it is now
        ([0.0, 10.0, 20.0], 0, False),
        ([0.0, 60.0, 0.0], 2, True),
    ],
)
def test_a_side_that_was_seen_before_it_turned_away_has_nothing_new(shown, turned_to, again):
    known = map_with_points(shown)
    assert seen_again(known, known.keyframes[turned_to].pose) is again
