"""What holds a pose against turning: texture does, a solid of revolution without any turns for nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from rendered_solids import observed, pose_of, shape_of, surface_of

from tracking3d.estimation.online.optimization.observability import least_constrained_axis
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose
from tracking3d.geometry.pose import from_matrix, rotation_about

ROUND = surface_of(shape_of((0.6, 0.9, 0.6)))
PLAIN = replace(ROUND, texture=torch.full_like(ROUND.texture, 0.4))
UPRIGHT = pose_of(0)


def fit_of(surface):
    return refine_pose(surface, observed(surface, UPRIGHT), UPRIGHT, iterations=(0,))


def test_without_texture_it_turns_about_its_axis_for_nothing():
    cost, axis = least_constrained_axis(fit_of(PLAIN))
    assert abs(axis[1]) > 0.95
    textured, _ = least_constrained_axis(fit_of(ROUND))
    assert textured > 20 * cost


def test_the_cost_is_about_what_the_turn_costs_indeed():
    """Of texture alone, whose loss is nearly a parabola for a small turn."""
    fit = fit_of(ROUND)
    _, axis = least_constrained_axis(fit)
    turned = from_matrix(
        rotation_about(torch.tensor(axis.copy()).float(), 1.0) @ UPRIGHT.R, UPRIGHT.translation
    )
    frame = observed(ROUND, UPRIGHT)
    dearer = refine_pose(ROUND, frame, turned, iterations=(0,)).cost - fit.cost
    assert dearer * 100 == pytest.approx(least_constrained_axis(fit)[0], rel=0.7)


def test_where_nothing_is_known_nothing_holds():
    fit = fit_of(ROUND)
    for information in (torch.zeros(6, 6), torch.full((6, 6), torch.nan)):
        cost, axis = least_constrained_axis(replace(fit, information=information))
        assert cost == 0 and np.linalg.norm(axis) == pytest.approx(1)
