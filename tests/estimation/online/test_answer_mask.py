"""The answered mask: rendered, initial, or what lies between both, by what the pixels beside the mask look like."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from patterns import disc
from rendered_solids import observed, pose_of, shape_of, surface_of

from tracking3d.estimation.estimate import MaskSource
from tracking3d.estimation.online.answer_mask import answer_mask, support_beside
from tracking3d.estimation.online.belief import View
from tracking3d.estimation.online.points import FollowedPoints

SIZE = (160, 240)
RENDERED, NEAR, FAR = disc(SIZE, (106, 80), 50), disc(SIZE, (100, 80), 50), disc(SIZE, (140, 80), 50)


def right_edge(mask) -> int:
    return int(np.flatnonzero(mask.any(0)).max())


def test_without_an_initial_mask_it_is_the_silhouette():
    np.testing.assert_array_equal(answer_mask(RENDERED, None, 0.0)[0], RENDERED)


@pytest.mark.parametrize("support", [0.0, 0.5, 1.0])
def test_two_masks_that_are_the_same_are_the_answer(support):
    np.testing.assert_array_equal(answer_mask(RENDERED, RENDERED, support)[0], RENDERED)


def test_outlines_of_masks_that_are_alike_are_averaged_unless_the_rendered_one_has_no_support():
    # Six pixels apart: 0.6 of the way to the rendered outline.
    assert right_edge(NEAR) == 150
    assert right_edge(answer_mask(RENDERED, NEAR, 1.0)[0]) == 153
    np.testing.assert_array_equal(answer_mask(RENDERED, NEAR, 0.0)[0], NEAR)


def test_where_masks_differ_the_supported_one_is_the_answer():
    np.testing.assert_array_equal(answer_mask(RENDERED, FAR, 0.7)[0], RENDERED)
    np.testing.assert_array_equal(answer_mask(RENDERED, FAR, 0.2)[0], FAR)


def test_where_neither_is_clearly_right_it_lies_between():
    between = answer_mask(RENDERED, FAR, 0.45)[0]
    assert (between & ~(RENDERED | FAR)).sum() == 0
    assert (RENDERED & FAR & ~between).sum() == 0
    assert not (between == RENDERED).all()
    assert not (between == FAR).all()


def test_the_answer_says_where_it_comes_from():
    assert answer_mask(RENDERED, None, 0.0)[1] is MaskSource.RENDERED
    assert answer_mask(RENDERED, FAR, 0.7)[1] is MaskSource.RENDERED
    assert answer_mask(RENDERED, NEAR, 1.0)[1] is answer_mask(RENDERED, FAR, 0.45)[1] is MaskSource.MEAN
    assert answer_mask(RENDERED, NEAR, 0.0)[1] is MaskSource.INITIAL
    assert [source for source in MaskSource if source.is_own] == [MaskSource.RENDERED, MaskSource.MEAN]


def test_an_empty_silhouette_beside_a_mask_is_no_traceback():
    nothing = np.zeros(SIZE, bool)
    assert answer_mask(nothing, NEAR, 0.0)[0].sum() == NEAR.sum()
    assert not answer_mask(nothing, nothing, 1.0)[0].any()


SHAPE = shape_of()
SURFACE, POSE = surface_of(SHAPE), pose_of(20)


def half_masked(features=None) -> View:
    """The mask covers the left half of the object; beside it the pixels may differ."""
    whole = observed(SURFACE, POSE)
    mask = whole.mask.clone()
    mask[:, 32:] = 0
    shown = whole.features if features is None else torch.where(mask > 0, whole.features, features)
    return View(replace(whole, mask=mask, features=shown), mask.numpy() > 0.5, POSE, FollowedPoints.none())


def test_what_looks_like_the_object_beside_the_mask_supports_the_silhouette():
    assert support_beside(SURFACE, half_masked(), POSE, 0.25) > 0.9


def test_what_looks_otherwise_does_not():
    other = torch.full((3, 64, 64), -2.0)
    assert support_beside(SURFACE, half_masked(other), POSE, 0.25) == 0


def test_texture_that_was_never_seen_supports_nothing():
    unseen = replace(SURFACE, seen=torch.zeros_like(SURFACE.seen))
    assert support_beside(unseen, half_masked(), POSE, 0.25) == 0


def test_with_nothing_beside_the_mask_nothing_contradicts():
    view = half_masked()
    everywhere = replace(view, observation=replace(view.observation, mask=torch.ones(64, 64)))
    assert support_beside(SURFACE, everywhere, POSE, 0.25) == 1
    nowhere = replace(view, observation=replace(view.observation, mask=torch.zeros(64, 64)))
    assert support_beside(SURFACE, nowhere, POSE, 0.25) == 1
