"""Perspective-correct attributes at covered pixels, against ray casting and finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from implementations import TORCH64, everywhere, in_float32
from render_oracle import cast_rays
from scenes import Scene, bumpy_sphere, rounded, triangles
from torch import Tensor
from torch.autograd import gradcheck

from tracking3d.rendering import rasterize
from tracking3d.rendering.interpolation import interpolate


def attributes_of(scene: Scene, channels: int = 4) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(len(scene.faces), 3, channels, generator=generator, dtype=torch.float64)
    return rounded(values).to(scene.screen.dtype)


def visible(scene: Scene) -> Tensor:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size, scene.backend).face_index


def values_of(scene: Scene, attributes: Tensor, index: Tensor | None = None) -> Tensor:
    index = visible(scene) if index is None else index
    return interpolate(scene.screen, scene.depth, scene.faces, attributes, index, scene.backend)


def expected_of(scene: Scene, attributes: Tensor) -> np.ndarray:
    views = zip(scene.screen.double(), scene.depth.double(), strict=True)
    pictures = [cast_rays(s.numpy(), d.numpy(), scene.faces.numpy(), scene.size) for s, d in views]
    assert np.array_equal(visible(scene), np.stack([picture.face_index for picture in pictures]))
    return np.concatenate([picture.interpolate(attributes.double().numpy()) for picture in pictures])


def assert_interpolated_as_cast(scene: Scene) -> None:
    attributes = attributes_of(scene)
    exact = scene.screen.dtype == torch.float64
    close = {"rtol": 1e-7, "atol": 1e-9} if exact else {"rtol": 0, "atol": 1e-4}
    np.testing.assert_allclose(values_of(scene, attributes), expected_of(scene, attributes), **close)


@everywhere
@pytest.mark.parametrize("size", [(24, 24), (13, 31), (33, 10)])
@pytest.mark.parametrize("seed", range(4))
def test_attributes_of_random_triangles_are_those_where_the_rays_meet_them(seed, size, by):
    assert_interpolated_as_cast(triangles(seed, size).by(by))


@everywhere
@pytest.mark.parametrize("spread", [0.03, 3.0])
def test_attributes_of_tiny_and_huge_triangles_are_right(spread, by):
    assert_interpolated_as_cast(triangles(7, faces=60, spread=spread).by(by))


@everywhere
def test_attributes_of_a_closed_mesh_are_those_where_the_rays_meet_it(by):
    assert_interpolated_as_cast(bumpy_sphere((30, 40)).scene.by(by))


@everywhere
@pytest.mark.parametrize("channels", [1, 2, 3, 7])
def test_any_number_of_attributes_is_interpolated_like_each_alone(channels, by):
    scene = triangles(5).by(by)
    attributes = attributes_of(scene, channels)
    alone = [values_of(scene, attributes[..., k : k + 1]) for k in range(channels)]
    torch.testing.assert_close(values_of(scene, attributes), torch.cat(alone, 1), rtol=0, atol=1e-6)


@everywhere
def test_attributes_may_differ_from_view_to_view(by):
    scene = triangles(5, views=3).by(by)
    attributes = torch.stack([attributes_of(scene) * factor + factor for factor in (1, 2, -3)])
    together = values_of(scene, attributes)
    alone = [
        values_of(replace(scene, screen=screen[None], depth=depth[None]), own)
        for screen, depth, own in zip(scene.screen, scene.depth, attributes, strict=True)
    ]
    torch.testing.assert_close(together, torch.cat(alone))


@everywhere
def test_barycentrics_as_attributes_are_the_rays_barycentrics(by):
    scene = triangles(5, views=1).by(by)
    rays = scene.screen[0].double().numpy(), scene.depth[0].double().numpy()
    picture = cast_rays(*rays, scene.faces.numpy(), scene.size)
    values = values_of(scene, torch.eye(3, dtype=by.dtype).expand(len(scene.faces), 3, 3))
    atol = 1e-9 if by.exact else 1e-4
    np.testing.assert_allclose(values, picture.barycentrics[picture.face_index >= 0], atol=atol)


@everywhere
def test_halfway_on_the_screen_is_nearer_than_halfway_on_the_surface(by):
    screen = torch.tensor([[[0.0, 0.0], [0.0, 8.0], [8.0, 0.0]]], dtype=by.dtype)
    depth = torch.tensor([[1.0, 1.0, 3.0]], dtype=by.dtype)
    along = torch.tensor([[[0.0], [0.0], [1.0]]], dtype=by.dtype)
    face_index = torch.full((1, 9, 9), -1)
    face_index[0, 0, 4] = 0
    value = interpolate(screen, depth, torch.tensor([[0, 1, 2]]), along, face_index, by.backend)
    # Screen weights 1/2 and 1/2 over depths 1 and 3: (1/2)/3 of (1/2)/1 + (1/2)/3.
    assert value.tolist() == [[pytest.approx(0.25)]]


@pytest.mark.parametrize("scene", [triangles(8, (12, 15), faces=8), bumpy_sphere((14, 14)).scene])
def test_gradients_by_vertices_depths_and_attributes_are_those_of_finite_differences(scene):
    index, attributes = visible(scene), attributes_of(scene, 2)
    assert (index >= 0).any()

    def values(screen: Tensor, depth: Tensor, attributes: Tensor) -> Tensor:
        return values_of(replace(scene, screen=screen, depth=depth), attributes, index)

    inputs = [tensor.clone().requires_grad_() for tensor in (scene.screen, scene.depth, attributes)]
    assert gradcheck(values, inputs, fast_mode=len(scene.faces) > 20)


@everywhere
def test_one_input_alone_may_ask_for_its_gradient(by):
    scene = triangles(8, (12, 15), faces=8).by(by)
    attributes = attributes_of(scene).requires_grad_()
    values_of(scene, attributes).sum().backward()
    # Every pixel gives its attributes a share of one.
    assert attributes.grad.sum() == pytest.approx(4 * float((visible(scene) >= 0).sum()))
    for name in ("screen", "depth"):
        leaf = getattr(scene, name).clone().requires_grad_()
        values_of(replace(scene, **{name: leaf}), attributes_of(scene)).sum().backward()
        assert leaf.grad.norm() > 0


@everywhere
def test_a_picture_without_covered_pixels_gives_no_rows_and_zero_gradients(by):
    scene = triangles(8).by(by)
    scene.screen.requires_grad_()
    values = values_of(scene, attributes_of(scene), torch.full((2, *scene.size), -1))
    assert values.shape == (0, 4)
    values.sum().backward()
    assert (scene.screen.grad == 0).all()


@everywhere
def test_no_faces_at_all_give_no_rows(by):
    scene = triangles(8).by(by)
    scene = replace(scene, faces=scene.faces[:0], screen=scene.screen.requires_grad_())
    attributes = attributes_of(scene).requires_grad_()
    values = values_of(scene, attributes)
    assert values.shape == (0, 4)
    values.sum().backward()
    assert (scene.screen.grad == 0).all() and attributes.grad.shape == (0, 3, 4)


@in_float32
def test_float32_agrees_with_float64(by):
    scene = bumpy_sphere((48, 48), frequency=8).scene
    index, results = visible(scene), []
    for implementation in (by, TORCH64):
        cast = scene.by(implementation)
        leaves = [leaf.clone().requires_grad_() for leaf in (cast.screen, cast.depth, attributes_of(cast))]
        values = values_of(replace(cast, screen=leaves[0], depth=leaves[1]), leaves[2], index)
        (values**2).sum().backward()
        results.append((values.double(), [leaf.grad.double() for leaf in leaves]))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=2e-5)
    for low, high in zip(results[0][1], results[1][1], strict=True):
        assert torch.linalg.norm(low - high) < 1e-4 * torch.linalg.norm(high)
