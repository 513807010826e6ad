"""Adam over poses, shape and texture: what moves, when it ends, and what it answers."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from small_scenes import observed, painted, parameters_of, pose_of, problem_of

from tracking3d.estimation.paper.problem import Losses, Optimum, Problem, optimize
from tracking3d.geometry.pose import rotation_angle

SLOW = {"translation": 0.01, "rotation": 0.01, "vertices": 0.005, "texture": 0.02}
NEVER = 1e-9
"""A convergence threshold that is not reached."""


def two_frames(flat: bool = False, **solver: object) -> Problem:
    settings = {"learning_rates": SLOW, "weights": {"laplacian": 10.0}, **solver}
    return problem_of([observed(pose_of(0)), observed(pose_of(8, x=0.05), 1)], flat, **settings)


START = parameters_of([pose_of(0), pose_of(0)])


def run(problem: Problem, **options) -> Optimum:
    return optimize(problem, START, **{"iterations": 8, "tau": NEVER, **options})


def test_everything_moves_where_nothing_is_held():
    end = run(two_frames()).parameters
    for name in ("translation", "quaternion", "offsets", "texture"):
        assert not torch.equal(getattr(end, name), getattr(START, name)), name


def test_fixed_leading_frames_do_not_move():
    end = run(two_frames(), fixed=1).parameters
    assert torch.equal(end.translation[0], START.translation[0])
    assert torch.equal(end.quaternion[0], START.quaternion[0])
    assert not torch.equal(end.translation[1], START.translation[1])
    assert not torch.equal(end.quaternion[1], START.quaternion[1])


def test_pose_alone_leaves_shape_and_texture_untouched():
    end = run(two_frames(), free="pose").parameters
    assert torch.equal(end.offsets, START.offsets)
    assert torch.equal(end.texture, START.texture)
    assert not torch.equal(end.quaternion, START.quaternion)


@pytest.mark.parametrize(
    ("group", "tensor"),
    [
        ("translation", "translation"),
        ("rotation", "quaternion"),
        ("vertices", "offsets"),
        ("texture", "texture"),
    ],
)
def test_a_group_without_a_learning_rate_does_not_move(group, tensor):
    end = run(two_frames(learning_rates={**SLOW, group: 0.0})).parameters
    assert torch.equal(getattr(end, tensor), getattr(START, tensor))


@pytest.mark.parametrize("stop", ["threshold", "plateau"])
def test_where_nothing_may_move_the_start_is_the_answer(stop):
    end = run(two_frames(stop=stop, learning_rates=dict.fromkeys(SLOW, 0.0)))
    assert end.reason == ""
    assert torch.equal(end.parameters.translation, START.translation)
    assert torch.equal(end.parameters.offsets, START.offsets)


def test_the_start_is_left_as_it_was():
    before = [
        tensor.clone() for tensor in (START.translation, START.quaternion, START.offsets, START.texture)
    ]
    run(two_frames())
    after = [START.translation, START.quaternion, START.offsets, START.texture]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert not any(tensor.requires_grad for tensor in after)


def test_the_answer_has_unit_quaternions_and_no_graph():
    end = run(two_frames(learning_rates={**SLOW, "rotation": 0.3}))
    torch.testing.assert_close(end.parameters.quaternion.norm(dim=1), torch.ones(2))
    assert not end.parameters.offsets.requires_grad
    assert not end.losses.features.requires_grad


def test_pose_is_found_against_a_known_object():
    truth = pose_of(8, x=0.05)
    problem = problem_of(
        [observed(truth)], learning_rates=SLOW, stop="plateau", patience=30, silhouette_bias="none"
    )
    end = optimize(problem, parameters_of([pose_of(0)]), iterations=60, tau=NEVER, free="pose")
    error = math.degrees(rotation_angle(end.parameters.quaternion[0], truth.quaternion))
    assert error < 1
    assert (end.parameters.translation[0] - truth.translation)[:2].norm() < 0.02


def test_threshold_ends_at_once_where_the_appearance_is_explained():
    end = run(two_frames(), tau=1000.0)
    assert end.iterations == 1
    assert torch.equal(end.parameters.translation, START.translation)


def test_threshold_ends_as_soon_as_the_mean_appearance_loss_is_below_tau():
    at_start = run(two_frames(), iterations=1)
    tau = 0.5 * at_start.losses.features.mean().item()
    end = run(two_frames(), iterations=100, tau=tau)
    assert 1 < end.iterations < 100
    assert end.losses.features.mean() < tau
    before = run(two_frames(), iterations=end.iterations - 1)
    assert before.losses.features.mean() >= tau


def test_threshold_ends_after_the_last_iteration_with_the_state_it_reached():
    end = run(two_frames(), iterations=5)
    assert (end.iterations, end.reason) == (5, "")


def test_plateau_answers_with_the_best_state_that_was_seen():
    # Steps far too long: the loss jumps about.
    wild = two_frames(stop="plateau", patience=100, learning_rates=dict.fromkeys(SLOW, 0.15))
    end = run(wild, iterations=12)
    totals = [
        run(two_frames(learning_rates=dict.fromkeys(SLOW, 0.15)), iterations=n).total for n in range(1, 13)
    ]
    assert end.iterations == 12
    assert min(totals) < totals[-1]
    assert end.total == pytest.approx(min(totals), rel=1e-5)


def test_losses_of_the_answer_are_those_of_its_parameters():
    problem = two_frames(stop="plateau", weights={"total_variation": 0.0})
    end = run(problem)
    again = problem.losses(end.parameters)
    torch.testing.assert_close(again.features, end.losses.features, rtol=1e-3, atol=1e-5)
    assert end.total == pytest.approx(again.total(problem.config.weights).item(), rel=1e-3)


def test_plateau_is_never_worse_than_the_start_and_gives_up_after_its_patience():
    hopeless = two_frames(stop="plateau", patience=4, learning_rates=dict.fromkeys(SLOW, 50.0))
    end = run(hopeless, iterations=100)
    assert end.iterations == 1 + 4
    assert torch.equal(end.parameters.offsets, START.offsets)
    assert end.reason == ""


def test_plateau_takes_no_notice_of_tau():
    assert run(two_frames(stop="plateau"), tau=1000.0).iterations == 8


@pytest.mark.parametrize("stop", ["threshold", "plateau"])
def test_a_loss_that_is_no_number_gives_a_reason_and_keeps_the_start(stop):
    broken = observed(pose_of(0))
    broken = replace(broken, features=torch.full_like(broken.features, math.nan))
    problem = problem_of([broken, observed(pose_of(8), 1)], stop=stop)
    end = run(problem)
    assert end.reason == "the loss became nan in iteration 1"
    assert end.iterations == 1
    assert torch.equal(end.parameters.translation, START.translation)
    assert torch.equal(end.parameters.texture, START.texture)


@pytest.mark.parametrize("stop", ["threshold", "plateau"])
def test_a_loss_that_becomes_infinite_later_leaves_finite_parameters(stop, monkeypatch):
    healthy = Problem.losses
    calls: list[int] = []

    def failing(self: Problem, parameters) -> Losses:
        calls.append(1)
        losses = healthy(self, parameters)
        return replace(losses, motion=losses.motion + (math.inf if len(calls) == 4 else 0.0))

    monkeypatch.setattr(Problem, "losses", failing)
    end = run(two_frames(stop=stop))
    assert end.reason == "the loss became inf in iteration 4"
    for tensor in (end.parameters.translation, end.parameters.offsets, end.parameters.texture):
        assert tensor.isfinite().all()


def test_flat_prior_keeps_all_vertices_in_one_plane():
    problem = two_frames(flat=True, weights={"laplacian": 0.0}, stop="plateau", patience=30)
    rest = problem.shape.rest
    flat = START.offsets.clone()
    flat[:, 2] = -rest[:, 2]
    end = optimize(problem, replace(START, offsets=flat), iterations=20, tau=NEVER, fixed=1)
    vertices = rest + end.parameters.offsets
    assert torch.linalg.svdvals(vertices - vertices.mean(0))[2] < 1e-4
    assert not torch.equal(end.parameters.offsets, flat)


def test_texture_is_learned_from_nothing():
    problem = problem_of(
        [observed(pose_of(0))], learning_rates={**SLOW, "texture": 0.1}, weights={"laplacian": 10.0}
    )
    dark = parameters_of([pose_of(0)], torch.zeros_like(painted()))
    end = optimize(problem, dark, iterations=60, tau=0.02, fixed=1)
    assert end.losses.features < 0.02
