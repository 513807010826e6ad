"""Perspective-correct attributes at covered pixels, against ray casting and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from render_oracle import cast_rays
from scenes import Scene, bumpy_sphere, triangles
from torch import Tensor
from torch.autograd import gradcheck

from tracking3d.rendering import rasterize
from tracking3d.rendering.interpolation import interpolate


def attributes_of(scene: Scene, depth: int = 4) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(len(scene.faces), 3, depth, generator=generator, dtype=torch.float64)


def visible(scene: Scene) -> Tensor:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size).face_index


def assert_interpolated_as_cast(scene: Scene) -> None:
    attributes, faces = attributes_of(scene), scene.faces.numpy()
    expected = [
        cast_rays(screen.numpy(), depth.numpy(), faces, scene.size).interpolate(attributes.numpy())
        for screen, depth in zip(scene.screen, scene.depth, strict=True)
    ]
    values = interpolate(scene.screen, scene.depth, scene.faces, attributes, visible(scene))
    np.testing.assert_allclose(values, np.concatenate(expected), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("size", [(24, 24), (13, 31), (33, 10)])
@pytest.mark.parametrize("seed", range(4))
def test_attributes_of_random_triangles_are_those_where_the_rays_meet_them(seed, size):
    assert_interpolated_as_cast(triangles(seed, size))


@pytest.mark.parametrize("spread", [0.03, 3.0])
def test_attributes_of_tiny_and_huge_triangles_are_right(spread):
    assert_interpolated_as_cast(triangles(7, faces=60, spread=spread))


def test_attributes_of_a_closed_mesh_are_those_where_the_rays_meet_it():
    assert_interpolated_as_cast(bumpy_sphere((30, 40)).scene)


def test_barycentrics_as_attributes_are_the_rays_barycentrics():
    scene = triangles(5, views=1)
    picture = cast_rays(scene.screen[0].numpy(), scene.depth[0].numpy(), scene.faces.numpy(), scene.size)
    corners = torch.eye(3, dtype=torch.float64).expand(len(scene.faces), 3, 3)
    values = interpolate(scene.screen, scene.depth, scene.faces, corners, visible(scene))
    np.testing.assert_allclose(values, picture.barycentrics[picture.face_index >= 0], atol=1e-9)


def test_halfway_on_the_screen_is_nearer_than_halfway_on_the_surface():
    screen = torch.tensor([[[0.0, 0.0], [0.0, 8.0], [8.0, 0.0]]])
    depth = torch.tensor([[1.0, 1.0, 3.0]])
    along = torch.tensor([[[0.0], [0.0], [1.0]]])
    face_index = torch.full((1, 9, 9), -1)
    face_index[0, 0, 4] = 0
    value = interpolate(screen, depth, torch.tensor([[0, 1, 2]]), along, face_index)
    # Screen weights 1/2 and 1/2 over depths 1 and 3: (1/2)/3 of (1/2)/1 + (1/2)/3.
    assert value.tolist() == [[pytest.approx(0.25)]]


@pytest.mark.parametrize("scene", [triangles(8, (12, 15), faces=8), bumpy_sphere((14, 14)).scene])
def test_gradients_by_vertices_depths_and_attributes_are_those_of_finite_differences(scene):
    index, attributes = visible(scene), attributes_of(scene, 2)
    assert (index >= 0).any()

    def values(screen: Tensor, depth: Tensor, attributes: Tensor) -> Tensor:
        return interpolate(screen, depth, scene.faces, attributes, index)

    inputs = [tensor.clone().requires_grad_() for tensor in (scene.screen, scene.depth, attributes)]
    assert gradcheck(values, inputs, fast_mode=len(scene.faces) > 20)


def test_one_input_alone_may_ask_for_its_gradient():
    scene = triangles(8, (12, 15), faces=8)
    attributes = attributes_of(scene).requires_grad_()
    interpolate(scene.screen, scene.depth, scene.faces, attributes, visible(scene)).sum().backward()
    # Every pixel gives its attributes a share of one.
    assert attributes.grad.sum() == pytest.approx(4 * float((visible(scene) >= 0).sum()))


def test_a_picture_without_covered_pixels_gives_no_rows_and_zero_gradients():
    scene = triangles(8)
    screen = scene.screen.clone().requires_grad_()
    empty = torch.full((2, *scene.size), -1)
    values = interpolate(screen, scene.depth, scene.faces, attributes_of(scene), empty)
    assert values.shape == (0, 4)
    values.sum().backward()
    assert (screen.grad == 0).all()


def test_float32_agrees_with_float64():
    scene = bumpy_sphere((48, 48), frequency=8).scene
    attributes, index = attributes_of(scene), visible(scene)
    results = []
    for dtype in (torch.float32, torch.float64):
        cast = scene.to(dtype)
        screen = cast.screen.requires_grad_()
        values = interpolate(screen, cast.depth, cast.faces, attributes.to(dtype), index)
        (values**2).sum().backward()
        results.append((values.double(), screen.grad.double()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-4)
    difference = torch.linalg.norm(results[0][1] - results[1][1]) / torch.linalg.norm(results[1][1])
    assert difference < 1e-3
