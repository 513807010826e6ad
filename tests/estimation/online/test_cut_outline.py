"""A mask that the frame's border or an occluder cuts off has no outline there."""

from __future__ import annotations

from dataclasses import replace

import torch
from turned_solid import turned_map

from tracking3d.estimation.observation import Observation
from tracking3d.rendering import signed_distance

BORDER = 40  # columns from here on are beyond the frame


def bar(cut: bool) -> Observation:
    """Rows 20 to 40 from column 10 on, to the frame's border or to column 29."""
    mask, valid = torch.zeros(64, 64), torch.ones(64, 64)
    valid[:, BORDER:] = 0
    mask[20:41, 10 : BORDER if cut else 30] = 1
    return replace(turned_map([0.0]).keyframes[0].observation, mask=mask, valid=valid)


def test_the_cut_is_no_outline():
    distance = bar(cut=True).outline_distance
    assert float(distance[30, BORDER - 1]) == -10.5  # to the lower edge, rows 40 and 41
    assert float(distance[45, BORDER - 1]) == 4.5
    assert float(distance[30, 10]) == -0.5  # the left end is one


def test_beyond_the_border_nothing_pulls():
    assert float(bar(cut=True).outline_distance[:, BORDER:].abs().max()) == 0


def test_a_mask_away_from_the_border_keeps_its_outline():
    whole = bar(cut=False)
    inside = whole.outline_distance[:, :BORDER]
    torch.testing.assert_close(inside, signed_distance(whole.mask[None])[0][:, :BORDER])
    assert float(inside[30, 29]) == -0.5
    assert float(inside[30, 30]) == 0.5


def test_where_all_is_inside_the_frame_it_is_the_plain_distance():
    observation = replace(bar(cut=True), valid=torch.ones(64, 64))
    torch.testing.assert_close(observation.outline_distance, signed_distance(observation.mask[None])[0])


def test_a_frame_that_is_filled_or_empty_has_no_outline():
    for value in (0.0, 1.0):
        observation = bar(cut=True)
        filled = replace(observation, mask=torch.full((64, 64), value) * observation.valid)
        assert float(filled.outline_distance.abs().max()) == 0


def test_behind_an_occluder_poses_see_no_outline_and_surfaces_the_hull_at_a_lower_weight():
    inside = replace(bar(cut=False), valid=torch.ones(64, 64))
    hand = torch.zeros(64, 64)
    hand[:, 30:45] = 1  # where the bar ends
    hidden = replace(inside, occluder=hand)
    free = hidden.free_outline_distance
    assert (
        float(free[30, 29]) == -8.5
    )  # the bar goes on to the middle of the hand, beyond which background is nearer
    assert float(free[:, 30:45].abs().max()) == 0
    assert float(free[30, 10]) == -0.5
    surface, covered = hidden.outline_distance, hand > 0
    torch.testing.assert_close(surface[~covered], inside.outline_distance[~covered])
    torch.testing.assert_close(surface[covered], 0.4 * inside.outline_distance[covered])  # a bar is convex
    assert not bool(hidden.target.inside[covered].any())
    torch.testing.assert_close(inside.free_outline_distance, inside.outline_distance)


def test_at_half_the_resolution_the_occluder_is_still_there():
    hand = torch.zeros(64, 64)
    hand[:, 30:45] = 1
    half = replace(bar(cut=False), occluder=hand).half
    assert float(half.free_outline_distance[:, 16:22].abs().max()) == 0
