"""Bilinear texture sampling that goes on across the seam."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from render_oracle import bilinear
from torch.autograd import gradcheck

from tracking3d.rendering import sample_texture
from tracking3d.rendering.surface import bilinear_taps


@pytest.fixture
def texture() -> torch.Tensor:
    return torch.rand(3, 7, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_random_places_are_sampled_bilinearly(texture):
    uv = torch.rand(400, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 1.6 - 0.3
    expected = np.stack([bilinear(texture.numpy(), u, v) for u, v in uv.tolist()])
    np.testing.assert_allclose(sample_texture(texture, uv), expected, atol=1e-12)


def test_the_centre_of_a_texel_is_that_texel(texture):
    places = [[(column + 0.5) / 5, (row + 0.5) / 7] for row in range(7) for column in range(5)]
    uv = torch.tensor(places, dtype=torch.float64)
    torch.testing.assert_close(sample_texture(texture, uv), texture.flatten(1).T)


def test_halfway_across_the_seam_is_the_mean_of_both_sides(texture):
    for u in (0.0, 1.0, 2.0, -1.0):
        middle = sample_texture(texture, torch.tensor([[u, 0.5]], dtype=torch.float64))[0]
        torch.testing.assert_close(middle, (texture[:, 3, 0] + texture[:, 3, 4]) / 2)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_whole_turn_in_u_changes_nothing_and_nothing_jumps_at_the_seam(texture, dtype):
    u = torch.cat([torch.linspace(-0.2, 0.2, 81), torch.tensor([-1e-9, 1e-9, -1e-30, 1 - 1e-7])]).to(dtype)
    uv = torch.stack([u, torch.full_like(u, 0.4)], 1)
    turned = uv + torch.tensor([1.0, 0.0], dtype=dtype)
    values = sample_texture(texture.to(dtype), uv)
    torch.testing.assert_close(values, sample_texture(texture.to(dtype), turned), rtol=0, atol=1e-5)
    steps = values[1:81] - values[:80]
    assert steps.abs().max() < 1.01 * 5 * 0.4 / 80  # no texel differs from its neighbour by more than 1


def test_v_is_held_at_the_ends(texture):
    ends = sample_texture(texture, torch.tensor([[0.1, -3.0], [0.1, 0.0], [0.1, 1.0], [0.1, 9.0]]).double())
    torch.testing.assert_close(ends[0], texture[:, 0, 0])
    torch.testing.assert_close(ends[1], texture[:, 0, 0])
    torch.testing.assert_close(ends[2], texture[:, 6, 0])
    torch.testing.assert_close(ends[3], texture[:, 6, 0])


def test_gradients_by_texture_and_place_are_those_of_finite_differences(texture):
    uv = torch.rand(30, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 1.2 - 0.1
    assert gradcheck(sample_texture, (texture.requires_grad_(), uv.requires_grad_()))


def test_one_texel_and_no_places_at_all_are_no_exceptions():
    one = torch.rand(2, 1, 1)
    torch.testing.assert_close(sample_texture(one, torch.rand(4, 2)), one.reshape(1, 2).expand(4, 2))
    assert sample_texture(one, torch.zeros(0, 2)).shape == (0, 2)


def test_many_channels_are_sampled_like_few():
    texture = torch.rand(70, 6, 6, dtype=torch.float64)
    uv = torch.rand(50, 2, dtype=torch.float64)
    apart = torch.cat([sample_texture(texture[c : c + 1], uv) for c in range(70)], 1)
    torch.testing.assert_close(sample_texture(texture, uv), apart)


def test_float32_agrees_with_float64(texture):
    uv = torch.rand(200, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1.2 - 0.1
    low = sample_texture(texture.float(), uv.float())
    torch.testing.assert_close(low.double(), sample_texture(texture, uv), rtol=0, atol=1e-5)


def test_taps_are_the_samples_and_their_slopes(texture):
    uv = torch.rand(60, 2, generator=torch.Generator().manual_seed(4), dtype=torch.float64) * 1.4 - 0.2
    uv.requires_grad_()
    sampled = sample_texture(texture, uv)
    values, by_u, by_v = bilinear_taps(texture, uv.detach())
    torch.testing.assert_close(values, sampled.detach())
    for channel in range(3):
        (slope,) = torch.autograd.grad(sampled[:, channel].sum(), uv, retain_graph=True)
        torch.testing.assert_close(torch.stack([by_u[:, channel], by_v[:, channel]], 1), slope)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_place_that_is_not_finite_gives_nothing_and_pulls_at_nothing(texture, bad):
    uv = torch.rand(6, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    expected = sample_texture(texture, uv)
    uv[0, 0] = uv[3, 1] = bad
    uv.requires_grad_()
    sampled = sample_texture(texture.requires_grad_(), uv)
    assert sampled[[0, 3]].isnan().all()
    torch.testing.assert_close(sampled[[1, 2, 4, 5]], expected[[1, 2, 4, 5]])
    sampled[[1, 2, 4, 5]].sum().backward()
    assert uv.grad.isfinite().all() and texture.grad.isfinite().all()
