"""Cauchy losses of a texture against frames and of neighbouring texels, against their definition."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from implementations import NUMBA, TORCH64, Implementation, everywhere, in_float32
from render_oracle import bilinear
from scenes import rounded
from torch import Tensor
from torch.autograd import gradcheck

from tracking3d.rendering import channels_last, texture_losses

SCALE = 0.25
CHANNELS = [1, 3, 5, 16, 64, 70]
SIDES = [1, 2, 7, 8]


@dataclass(frozen=True, eq=False)
class Problem:
    """A texture, where it is seen, and two frames that show something else."""

    texture: Tensor
    uv: Tensor
    observed: Tensor
    pixels: Tensor

    @classmethod
    def random(cls, channels: int = 3, side: int = 7, places: int = 40) -> Problem:
        generator = torch.Generator().manual_seed(channels + 100 * side)
        texture, observed, uv = (
            rounded(torch.rand(shape, generator=generator, dtype=torch.float64))
            for shape in ((channels, side, side), (2, channels, 6, 9), (places, 2))
        )
        # u goes round and v leaves the texture; some pixels are seen twice and others never.
        pixels = torch.randint(2 * 6 * 9, (places,), generator=generator)
        return cls(texture, rounded(1.5 * uv - 0.25), observed, pixels)

    def losses(self, by: Implementation, **options: bool) -> tuple[Tensor, Tensor]:
        """What is under test; leaves stay leaves."""
        texture, uv, observed = (part.to(by.dtype) for part in (self.texture, self.uv, self.observed))
        return texture_losses(texture, uv, observed, self.pixels, SCALE, backend=by.backend, **options)

    def gradients(self, by: Implementation) -> list[Tensor]:
        """By texture and uv, of a weighted sum of all answers, in float64."""
        leaves = [part.to(by.dtype, copy=True).requires_grad_() for part in (self.texture, self.uv)]
        loss, variation = replace(self, texture=leaves[0], uv=leaves[1]).losses(by)
        weight = torch.linspace(-1, 2, len(loss), dtype=by.dtype)
        ((loss * weight).sum() + 3 * variation).backward()
        return [leaf.grad.double() for leaf in leaves]


def cauchy(difference: np.ndarray) -> np.ndarray:
    return np.log1p((difference / SCALE) ** 2)


def defined(problem: Problem) -> tuple[np.ndarray, float]:
    texture, observed = problem.texture.numpy(), problem.observed.numpy()
    rows = np.moveaxis(observed, 1, -1).reshape(-1, len(texture))[problem.pixels.numpy()]
    sampled = np.stack([bilinear(texture, u, v) for u, v in problem.uv.tolist()])
    right = cauchy(texture - np.roll(texture, -1, 2)).mean()
    below = cauchy(texture[:, 1:] - texture[:, :-1])
    return cauchy(sampled - rows).mean(1), float(right + (below.mean() if below.size else 0))


@everywhere
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("channels", CHANNELS)
def test_losses_are_as_defined(channels, side, by):
    problem = Problem.random(channels, side)
    loss, variation = problem.losses(by)
    expected, expected_variation = defined(problem)
    atol = 1e-9 if by.exact else 1e-5
    np.testing.assert_allclose(loss, expected, rtol=0, atol=atol)
    assert variation.item() == pytest.approx(expected_variation, abs=atol)
    assert loss.dtype == variation.dtype == by.dtype


@pytest.mark.parametrize("side", [2, 5])
@pytest.mark.parametrize("channels", [1, 3])
def test_gradients_are_those_of_finite_differences(channels, side):
    problem = Problem.random(channels, side, places=12)

    def losses(texture: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
        return replace(problem, texture=texture, uv=uv).losses(TORCH64)

    assert gradcheck(losses, (problem.texture.requires_grad_(), problem.uv.requires_grad_()))


@in_float32
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("channels", CHANNELS)
def test_gradients_in_float32_are_those_of_float64(channels, side, by):
    problem = Problem.random(channels, side)
    for gradient, exact in zip(problem.gradients(by), problem.gradients(TORCH64), strict=True):
        assert gradient.isfinite().all()
        assert torch.linalg.norm(gradient - exact) <= 1e-5 * torch.linalg.norm(exact)


@everywhere
def test_the_total_variation_is_computed_only_where_it_is_wanted(by):
    problem = Problem.random()
    problem.texture.requires_grad_()
    loss, variation = problem.losses(by, total_variation=False)
    assert variation.item() == 0
    assert torch.equal(loss, problem.losses(by)[0])
    (loss.sum() + variation).backward()
    alone = Problem.random()
    alone.texture.requires_grad_()
    alone.losses(by)[0].sum().backward()
    torch.testing.assert_close(problem.texture.grad, alone.texture.grad)


@everywhere
def test_the_total_variation_alone_may_be_asked_for_its_gradient(by):
    problem = Problem.random()
    problem.texture.requires_grad_()
    problem.uv.requires_grad_()
    problem.losses(by)[1].backward()
    assert problem.texture.grad.norm() > 0
    assert problem.uv.grad is None or (problem.uv.grad == 0).all()


@everywhere
def test_one_input_alone_may_ask_for_its_gradient(by):
    both = Problem.random().gradients(by)
    for name, expected in zip(("texture", "uv"), both, strict=True):
        problem = Problem.random()
        leaf = getattr(problem, name).requires_grad_()
        loss, variation = problem.losses(by)
        ((loss * torch.linspace(-1, 2, len(loss))).sum() + 3 * variation).backward()
        torch.testing.assert_close(leaf.grad, expected, rtol=1e-5, atol=1e-6)


@everywhere
@pytest.mark.parametrize("channels", [3, 5])
def test_the_layout_in_memory_changes_no_value(channels, by):
    problem = Problem.random(channels)
    expected, gradients = problem.losses(by), problem.gradients(by)
    wide = torch.stack([problem.uv, -problem.uv], 2)[..., 0]
    assert not wide.is_contiguous()
    turned = problem.texture.mT.contiguous().mT
    others = [
        replace(problem, texture=channels_last(problem.texture), observed=channels_last(problem.observed)),
        replace(problem, observed=problem.observed.contiguous(memory_format=torch.channels_last)),
        replace(problem, texture=turned, uv=wide),
        replace(problem, pixels=problem.pixels.repeat_interleave(2)[::2]),
    ]
    for other in others:
        for value, same in zip(other.losses(by), expected, strict=True):
            torch.testing.assert_close(value, same, rtol=1e-6, atol=1e-7)
        for gradient, same in zip(other.gradients(by), gradients, strict=True):
            torch.testing.assert_close(gradient, same, rtol=1e-5, atol=1e-6)


def test_channels_last_are_the_same_values_side_by_side():
    for image in (torch.rand(3, 4, 5), torch.rand(2, 3, 4, 5), torch.rand(2, 2, 3, 4, 5)):
        moved = channels_last(image)
        assert torch.equal(moved, image)
        assert moved.stride(-3) == 1 and moved.stride(-1) == 3


@everywhere
def test_a_whole_turn_in_u_changes_nothing(by):
    problem = Problem.random(5, 8)
    expected = problem.losses(by)[0]
    for turns in (-3, -1, 1, 2):
        turned = replace(problem, uv=problem.uv + torch.tensor([turns, 0.0])).losses(by)[0]
        torch.testing.assert_close(turned, expected, rtol=0, atol=1e-9 if by.exact else 3e-5)


@everywhere
def test_nothing_jumps_at_the_seam(by):
    problem = Problem.random(3, 8)
    u = torch.tensor([0.0, -0.0, 1e-30, -1e-30, 1e-9, -1e-9, 1 - 6e-8, 1.0, 1 + 1.2e-7, 2.0, -1.0])
    uv = torch.stack([u, torch.full_like(u, 0.4)], 1).double()
    same = replace(problem, uv=uv, pixels=torch.full((len(u),), 17))
    loss = same.losses(by)[0]
    torch.testing.assert_close(loss, loss[:1].expand_as(loss), rtol=0, atol=3e-5)


@everywhere
def test_v_is_held_at_the_ends_and_does_not_pull_there(by):
    v = torch.tensor([-1e30, -5.0, -0.1, 0.0, 0.05, 0.95, 1.0, 1.1, 7.0, 1e30])
    problem = replace(Problem.random(3, 8), uv=torch.stack([torch.full_like(v, 0.3), v], 1).double())
    problem = replace(problem, pixels=torch.full((len(v),), 20))
    problem.uv.requires_grad_()
    loss, _ = problem.losses(by)
    torch.testing.assert_close(loss[:5], loss[:1].expand(5))
    torch.testing.assert_close(loss[5:], loss[-1:].expand(5))
    loss.sum().backward()
    assert (problem.uv.grad[:, 1] == 0).all() and (problem.uv.grad[:, 0] != 0).all()


@everywhere
def test_no_places_at_all_leave_the_total_variation(by):
    expected = defined(Problem.random())[1]
    problem = replace(Problem.random(places=0), texture=Problem.random().texture.requires_grad_())
    loss, variation = problem.losses(by)
    assert loss.shape == (0,)
    assert variation.item() == pytest.approx(expected, abs=1e-5)
    (loss.sum() + variation).backward()
    assert problem.texture.grad.norm() > 0


@everywhere
def test_the_order_of_places_does_not_matter(by):
    problem = Problem.random()
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    shuffled = replace(problem, uv=problem.uv[order], pixels=problem.pixels[order])
    assert torch.equal(shuffled.losses(by)[0], problem.losses(by)[0][order])


@everywhere
@pytest.mark.parametrize("channels", [1, 3, 63, 64, 65, 130])
@pytest.mark.parametrize("residual", [1e-3, 1e2, 1e4, 1e8, 1e15])
def test_extreme_residuals_have_their_exact_loss(residual, channels, by):
    texture = torch.zeros(channels, 2, 2)
    signs = torch.where(torch.arange(channels) % 3 == 0, -1.0, 1.0)
    observed = (residual * signs)[None, :, None, None]
    pixels = torch.zeros(1, dtype=torch.long)
    loss, _ = Problem(texture, torch.full((1, 2), 0.5), observed, pixels).losses(by)
    # Below the rounding of 1 + r^2 nothing is left to tell.
    exact = math.log1p((residual / SCALE) ** 2)
    assert loss.item() == pytest.approx(exact, rel=1e-5, abs=1e-9 if by.exact else 1e-7)


@pytest.mark.parametrize("channels", [3, 64, 130])
@pytest.mark.parametrize("residual", [1e8, 1e19, 1e30])
def test_squares_too_large_for_float32_still_have_their_exact_loss(residual, channels):
    texture = torch.full((channels, 2, 2), 0.1)
    observed = torch.zeros(1, channels, 1, 1)
    observed[0, channels // 2] = residual  # among ordinary ones
    loss, _ = Problem(texture, torch.full((1, 2), 0.5), observed, torch.zeros(1, dtype=torch.long)).losses(
        NUMBA
    )
    exact = (channels - 1) * math.log1p((0.1 / SCALE) ** 2) + math.log1p((residual / SCALE) ** 2)
    assert loss.item() == pytest.approx(exact / channels, rel=1e-5)


@pytest.mark.parametrize("channels", [3, 70])
@pytest.mark.parametrize("side", [2, 9])
def test_a_texture_of_extremes_still_has_its_exact_total_variation(side, channels):
    generator = torch.Generator().manual_seed(side)
    texture = 10 ** (20 * torch.rand(channels, side, side, generator=generator))
    _, variation = replace(Problem.random(channels, side), texture=texture).losses(NUMBA)
    exact = defined(replace(Problem.random(channels, side), texture=texture.double()))[1]
    assert variation.item() == pytest.approx(exact, rel=1e-5)


@in_float32
@pytest.mark.parametrize("residual", [1e4, 1e8])
def test_extreme_residuals_pull_as_in_float64(residual, by):
    problem = Problem.random(16, 7)
    problem.observed[:, ::2] *= residual
    for gradient, exact in zip(problem.gradients(by), problem.gradients(TORCH64), strict=True):
        assert torch.linalg.norm(gradient - exact) < 1e-4 * torch.linalg.norm(exact)


@everywhere
@pytest.mark.parametrize("channels", [1, 3, 5, 70])
def test_a_value_that_is_not_a_number_shows_where_it_is_seen_and_nowhere_else(channels, by):
    problem = Problem.random(channels, 7)
    known = problem.losses(by)[0]
    seen = problem.pixels == problem.pixels[0]
    pixel = int(problem.pixels[0])
    problem.observed[pixel // 54, -1, pixel % 54 // 9, pixel % 9] = math.nan
    loss = problem.losses(by)[0]
    assert loss[seen].isnan().all() and torch.equal(loss[~seen], known[~seen])


@everywhere
@pytest.mark.parametrize("channels", [1, 3, 5, 70])
def test_a_texel_that_is_not_a_number_shows(channels, by):
    problem = Problem.random(channels, 7, places=400)
    problem.texture[-1, 3, 2] = math.nan
    problem.texture.requires_grad_()
    loss, variation = problem.losses(by)
    assert variation.isnan() and loss.isnan().any() and not loss.isnan().all()
    (loss.sum() + variation).backward()
    assert problem.texture.grad.isnan().any()


@everywhere
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_place_that_is_not_finite_has_no_loss(axis, bad, by):
    problem = Problem.random()
    problem.uv[::3, axis] = bad
    leaves = [leaf.requires_grad_() for leaf in (problem.texture, problem.uv)]
    loss, variation = problem.losses(by)
    assert loss[::3].isnan().all() and loss[1::3].isfinite().all() and variation.isfinite()
    (loss.sum() + variation).backward()
    assert all(leaf.grad.shape == leaf.shape for leaf in leaves)


@everywhere
def test_the_same_problem_gives_the_same_bits(by):
    first, second = (Problem.random(70, 8, places=3000) for _ in range(2))
    for a, b in zip(first.losses(by), second.losses(by), strict=True):
        assert torch.equal(a, b)
    for a, b in zip(first.gradients(by), second.gradients(by), strict=True):
        assert torch.equal(a, b)


@everywhere
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"texture": (3, 7)}, r"texture.*\(3, 7\).*\(C, T, T\)"),
        ({"texture": (3, 7, 8)}, r"texture.*\(3, 7, 8\).*\(C, T, T\)"),
        ({"uv": (40, 3)}, r"uv.*\(40, 3\).*\(P, 2\)"),
        ({"observed": (2, 4, 6, 9)}, r"observed.*\(2, 4, 6, 9\).*\(B, 3, H, W\)"),
        ({"observed": (3, 6, 9)}, r"observed.*\(3, 6, 9\).*\(B, 3, H, W\)"),
        ({"pixels": (41,)}, r"pixels.*\(41,\).*\(40\)"),
    ],
)
def test_a_shape_that_does_not_fit_is_named_with_the_one_expected(changes, said, by):
    problem = replace(Problem.random(), **{name: torch.zeros(shape) for name, shape in changes.items()})
    with pytest.raises(ValueError, match=said):
        problem.losses(by)
