"""A pose follows from pixels, outline and points together, and from each of them where the others say nothing."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from rendered_solids import SIZE, observed, pose_of, shape_of, surface_of
from torch import Tensor

from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.optimization.pose_refinement import _Evidence, refine_pose, refine_poses
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.geometry.pose import Pose, from_matrix, rotation_angle
from tracking3d.points.bundle_adjustment.reprojection import apply_pose_steps
from tracking3d.rendering import MatchedPoints, Surface

TRUTH = pose_of(20)
SURFACE = surface_of(shape_of())
FRAME = observed(SURFACE, TRUTH)
NO_MASK = observed(SURFACE, TRUTH, has_mask=False)
FLAT = replace(SURFACE, texture=torch.full_like(SURFACE.texture, 0.4))
AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, -1.0, 0.5)]


def moved_by(pose: Pose, step: Tensor) -> Pose:
    """The pose after a step (v, w)."""
    R, t = (part.double().numpy()[None] for part in (pose.R, pose.translation))
    turned, shifted = apply_pose_steps(R, t, step.double().numpy()[None])
    return from_matrix(torch.from_numpy(turned[0]).to(step), torch.from_numpy(shifted[0]).to(step))


def off(
    axis: tuple[float, float, float] = (1.0, -1.0, 0.5), degrees: float = 5.0, depth: float = 1.05
) -> Pose:
    """The true pose, turned and moved away."""
    length = math.sqrt(sum(part**2 for part in axis))
    turn = torch.tensor(axis) / length * math.radians(degrees)
    away = (depth - 1) * TRUTH.translation
    return moved_by(TRUTH, torch.cat([away, turn]))


def degrees(pose: Pose) -> float:
    return math.degrees(float(rotation_angle(pose.quaternion, TRUTH.quaternion)))


def pixels_of(points: Tensor, pose: Pose, K: Tensor = FRAME.K) -> Tensor:
    x_cam = (points @ pose.R.T + pose.translation) @ K.T
    return x_cam[:, :2] / x_cam[:, 2:]


def matched(count: int = 40) -> MatchedPoints:
    """Vertices on the side that faces the camera, where the true pose shows them."""
    x_cam = SURFACE.vertices @ TRUTH.R.T
    facing = torch.nonzero(x_cam[:, 2] < -0.1)[:, 0]
    points = SURFACE.vertices[facing[:: len(facing) // count][:count]]
    return MatchedPoints(points, pixels_of(points, TRUTH))


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("depth", [0.95, 1.05])
def test_pixels_and_outline_lead_to_the_true_pose_from_five_degrees_and_five_percent(axis, depth):
    fit = refine_pose(SURFACE, FRAME, off(axis, 5.0, depth), iterations=(8, 8))
    assert degrees(fit.pose) < 0.3
    assert (
        fit.pose.translation / TRUTH.translation[2] - TRUTH.translation / TRUTH.translation[2]
    ).norm() < 0.003


@pytest.mark.parametrize("axis", AXES)
def test_without_a_mask_the_pixels_do_it_and_there_is_no_outline_term(axis):
    fit = refine_pose(SURFACE, NO_MASK, off(axis, 5.0, 1.0), iterations=(8, 8))
    assert degrees(fit.pose) < 0.7
    assert fit.outline == 0 and fit.points == 0 and fit.overlap == 1
    assert fit.cost == pytest.approx(fit.appearance)


def test_where_texture_is_flat_points_alone_lead_to_the_true_pose():
    plain = observed(FLAT, TRUTH, has_mask=False)
    start = off()
    assert degrees(refine_pose(FLAT, plain, start, iterations=(8, 8)).pose) > 3
    fit = refine_pose(FLAT, plain, start, matched(), iterations=(8, 8))
    assert degrees(fit.pose) < 0.05
    assert (fit.pose.translation - TRUTH.translation).norm() < 0.005
    assert fit.points < 1e-3


def test_wrong_points_are_outvoted():
    points = matched()
    pixels = points.pixels.clone()
    pixels[::4] += torch.tensor([25.0, -15.0])
    plain = observed(FLAT, TRUTH, has_mask=False)
    fit = refine_pose(FLAT, plain, off(), replace(points, pixels=pixels), iterations=(10, 12))
    assert degrees(fit.pose) < 0.3


def test_the_outline_alone_finds_where_a_plain_object_is():
    """Not how it is turned: other ellipsoids have the same outline."""
    start = moved_by(TRUTH, torch.tensor([0.2, -0.15, 0.0, 0, 0, 0]))
    fits = [refine_pose(FLAT, observed(FLAT, TRUTH), start, iterations=steps) for steps in ((0, 0), (10, 10))]
    assert fits[0].overlap < 0.85 and fits[1].overlap > 0.98
    assert fits[1].outline < 0.05 * fits[0].outline


def test_the_true_pose_costs_next_to_nothing_and_stays():
    fit = refine_pose(SURFACE, FRAME, TRUTH, matched())
    assert fit.appearance < 1e-3 and fit.outline < 0.02 and fit.points < 1e-3
    assert degrees(fit.pose) < 0.05 and fit.overlap > 0.99


@pytest.mark.parametrize("start", [off(), off((0, 0, 1), 25.0, 1.0), off((0, 1, 0), 60.0, 1.3)])
def test_the_cost_never_rises_with_more_steps(start):
    costs = [refine_pose(SURFACE, FRAME, start, matched(), iterations=(n,)).cost for n in range(7)]
    assert costs == sorted(costs, reverse=True)
    assert costs[1] < costs[0]


def test_steps_that_fail_are_damped_until_they_succeed():
    """Twice as far away and turned by 60 degrees, the first steps lead nowhere better."""
    plain, start = observed(FLAT, TRUTH, has_mask=False), off((1.0, 0.0, 0.0), 60.0, 2.0)
    costs = [refine_pose(FLAT, plain, start, matched(), iterations=(n,)).cost for n in (0, 1, 2, 14)]
    assert costs[0] == costs[1] == costs[2] > 4
    assert costs[3] < 1e-3


STARTS = [
    off(),
    off((0.0, 1.0, 0.0), 60.0, 1.3),
    off((1.0, 0.0, 0.0), 60.0, 2.0),
    moved_by(TRUTH, torch.tensor([9.0, 0, 0, 0, 0, 0])),  # nothing of it in the window
]


def by_both(frame: Observation, starts: list[Pose], points: MatchedPoints | None, steps: tuple[int, ...]):
    """Pairs of fits, by the kernel and by torch."""
    return zip(
        *(
            refine_poses(replace(SURFACE, renderer=name), frame, starts, points, iterations=steps)
            for name in ("numba", "torch")
        ),
        strict=True,
    )


@pytest.mark.parametrize("frame", [FRAME, NO_MASK], ids=["mask", "no mask"])
@pytest.mark.parametrize("points", [matched(), None], ids=["points", "no points"])
def test_the_kernel_says_of_poses_what_torch_says(frame, points):
    for ours, twins in by_both(frame, STARTS, points, (0,)):
        numbers = [
            [fit.cost, fit.appearance, fit.outline, fit.points, fit.overlap, fit.unseen]
            for fit in (ours, twins)
        ]
        assert numbers[0] == pytest.approx(numbers[1], rel=1e-3, abs=1e-5)
        size = twins.information.abs().max()
        assert (ours.information - twins.information).abs().max() <= 1e-3 * size


@pytest.mark.parametrize("frame", [FRAME, NO_MASK], ids=["mask", "no mask"])
@pytest.mark.parametrize("points", [matched(), None], ids=["points", "no points"])
@pytest.mark.parametrize("steps", [(1,), (8, 8)])
def test_the_kernel_goes_where_torch_goes(frame, points, steps):
    """From an initial pose far off, a pixel's rounding can lead elsewhere, and take other steps to the same place."""
    for ours, twins in by_both(frame, STARTS[:1], points, steps):
        assert ours.cost == pytest.approx(twins.cost, rel=0.02, abs=1e-4)
        assert abs(ours.iterations - twins.iterations) <= max(2, sum(steps) // 3)
        assert rotation_angle(ours.pose.quaternion, twins.pose.quaternion) < 2e-3
        assert (ours.pose.translation - twins.pose.translation).norm() < 5e-3


def test_no_steps_only_evaluate():
    start = off()
    fit = refine_pose(SURFACE, FRAME, start, matched(), iterations=(0, 0))
    assert fit.pose is start
    assert fit.iterations == 1
    once = refine_pose(SURFACE, FRAME, start, matched(), iterations=(0,))
    assert (fit.cost, fit.appearance, fit.outline, fit.points) == (
        once.cost, once.appearance, once.outline, once.points
    )  # fmt: skip


def test_the_cost_is_the_weighted_sum_of_its_terms():
    weights = PoseWeights(appearance=2.0, outline=0.7, points=0.2)
    fit = refine_pose(SURFACE, FRAME, off(), matched(), weights, (0,))
    assert min(fit.appearance, fit.outline, fit.points) > 0
    assert fit.cost == pytest.approx(2.0 * fit.appearance + 0.7 * fit.outline + 0.2 * fit.points)


def test_what_weighs_nothing_has_no_say():
    start, wrong = off(), matched()
    wrong = replace(wrong, pixels=wrong.pixels + 9)
    with_points = refine_pose(SURFACE, FRAME, start, wrong, PoseWeights(points=0.0))
    without = refine_pose(SURFACE, FRAME, start, None, PoseWeights(points=0.0))
    assert torch.equal(with_points.pose.quaternion, without.pose.quaternion)
    assert with_points.points > 1


def test_no_points_are_the_same_as_none():
    empty = MatchedPoints(torch.zeros(0, 3), torch.zeros(0, 2))
    a, b = (refine_pose(SURFACE, FRAME, off(), points) for points in (empty, None))
    assert a.cost == b.cost and torch.equal(a.pose.quaternion, b.pose.quaternion)


def seen_right_half() -> Surface:
    """Only one half of the texture is known."""
    seen = torch.ones_like(SURFACE.seen)
    seen[..., : seen.shape[-1] // 2] = 0
    return replace(SURFACE, seen=seen)


def test_unseen_texture_is_charged_and_pulls_nowhere():
    unseen = replace(SURFACE, seen=torch.zeros_like(SURFACE.seen))
    fit = refine_pose(unseen, NO_MASK, off(), None, PoseWeights(unseen=0.37), (0,))
    assert fit.appearance == pytest.approx(0.37)
    assert not fit.information.any()
    assert torch.equal(refine_pose(unseen, NO_MASK, off()).pose.quaternion, off().quaternion)


def test_at_the_true_pose_the_charge_is_the_share_of_what_is_unseen():
    half = seen_right_half()
    costs = [
        refine_pose(half, FRAME, TRUTH, None, PoseWeights(unseen=c), (0,)).appearance for c in (0, 0.5, 1)
    ]
    share = costs[2] - costs[0]
    assert 0.05 < share < 0.95
    assert costs[1] - costs[0] == pytest.approx(share / 2)
    assert refine_pose(half, FRAME, TRUTH, iterations=(0,)).unseen == pytest.approx(share)
    assert refine_pose(SURFACE, FRAME, TRUTH, iterations=(0,)).unseen == pytest.approx(0, abs=1e-6)
    everything = refine_pose(SURFACE, FRAME, TRUTH, None, PoseWeights(), (0,)).appearance
    assert costs[0] <= everything + 1e-6


def test_two_halves_of_the_texture_cost_together_what_all_of_it_does():
    half, free, start = seen_right_half(), PoseWeights(unseen=0.0), off()
    other = replace(half, seen=1 - half.seen)
    costs = [refine_pose(part, FRAME, start, None, free, (0,)).appearance for part in (half, other, SURFACE)]
    assert min(costs) > 0 and costs[0] + costs[1] == pytest.approx(costs[2], rel=1e-4)


def test_a_pose_that_turns_the_unseen_side_forward_costs_more():
    half = seen_right_half()
    cost = {turn: refine_pose(half, observed(SURFACE, pose_of(turn)), pose_of(turn), iterations=(0,)).cost
            for turn in range(0, 360, 90)}  # fmt: skip
    assert max(cost.values()) > min(cost.values()) + 0.2


@pytest.mark.parametrize("frame", [FRAME, NO_MASK], ids=["mask", "no mask"])
def test_the_border_of_the_frame_hides_without_a_charge(frame):
    cut = replace(frame, valid=frame.valid.clone(), features=frame.features.clone(), mask=frame.mask.clone())
    for part in (cut.valid, cut.features, cut.mask):
        part[..., SIZE // 2 :] = 0
    fit = refine_pose(SURFACE, cut, TRUTH, None, PoseWeights(unseen=10.0), (0,))
    assert fit.appearance < 0.01
    assert fit.outline < 0.02
    assert fit.overlap > 0.99


def test_what_covers_the_object_is_not_compared_with_it():
    """Where the mask ends, something else is seen."""
    covered = replace(FRAME, features=FRAME.features.clone(), mask=FRAME.mask.clone())
    for part, value in ((covered.features, 1.0), (covered.mask, 0.0)):
        part[..., : SIZE // 2] = value
    fit = refine_pose(SURFACE, covered, TRUTH, iterations=(0,))
    assert fit.appearance < 1e-3 and 0.3 < fit.overlap < 0.7


def test_an_object_outside_the_window_is_the_worst_and_stays_finite():
    away = replace(TRUTH, translation=torch.tensor([30.0, 0, 3.5]))
    for frame in (FRAME, NO_MASK):
        fit = refine_pose(SURFACE, frame, away)
        assert math.isfinite(fit.cost)
        assert fit.appearance > refine_pose(SURFACE, frame, off(), iterations=(0,)).appearance
        assert fit.pose.translation.isfinite().all()
    assert refine_pose(SURFACE, FRAME, away).overlap == 0


def test_points_behind_the_camera_and_in_its_plane_give_finite_numbers():
    behind = MatchedPoints(torch.tensor([[0.0, 0, -9], [0.1, 0.2, -3.5]]), torch.full((2, 2), 30.0))
    fit = refine_pose(SURFACE, FRAME, pose_of(0), behind)
    assert math.isfinite(fit.cost) and fit.pose.quaternion.isfinite().all()


def test_points_at_half_the_resolution_are_the_same_points():
    """Coarse steps alone must lead to the same pose: pixel centres are at integers at both resolutions."""
    plain = observed(FLAT, TRUTH, has_mask=False)
    fit = refine_pose(FLAT, plain, off(), matched(), iterations=(12, 0))
    assert degrees(fit.pose) < 0.05 and fit.points < 1e-3


def test_at_half_the_resolution_scales_are_half_as_many_pixels():
    half = _Evidence(SURFACE, FRAME, matched(), PoseWeights(outline_scale=3.0, points_scale=5.0)).half()
    assert (half.weights.outline_scale, half.weights.points_scale) == (1.5, 2.5)
    assert half.observation.window.size == SIZE // 2
    assert half.matched is not None
    expected = pixels_of(half.matched.points, TRUTH, half.observation.K)
    torch.testing.assert_close(half.matched.pixels, expected, atol=1e-4, rtol=0)


def test_evaluations_of_all_resolutions_are_counted():
    counts = [refine_pose(SURFACE, FRAME, off(), iterations=n).iterations for n in ((3,), (3, 0), (2, 3))]
    assert counts == [4, 5, 7]


@pytest.mark.parametrize("iterations", [(0,), (0, 0), (3, 4)])
def test_several_starts_are_fitted_as_if_each_were_alone(iterations):
    starts = [
        off(),
        TRUTH,
        off((0, 0, 1), 25.0, 1.0),
        replace(TRUTH, translation=torch.tensor([30.0, 0, 3.5])),
    ]
    together = refine_poses(SURFACE, FRAME, starts, matched(), iterations=iterations)
    for start, fit in zip(starts, together, strict=True):
        alone = refine_pose(SURFACE, FRAME, start, matched(), iterations=iterations)
        assert (fit.cost, fit.iterations, fit.overlap) == (alone.cost, alone.iterations, alone.overlap)
        assert torch.equal(fit.pose.quaternion, alone.pose.quaternion)
    assert refine_poses(SURFACE, FRAME, []) == []


def test_a_step_turns_the_object_about_its_own_origin():
    turned = moved_by(TRUTH, torch.tensor([0.0, 0, 0, 0.1, 0.2, 0.3]))
    assert torch.equal(turned.translation, TRUTH.translation)
    assert degrees(turned) == pytest.approx(math.degrees(math.sqrt(0.14)), rel=1e-3)
