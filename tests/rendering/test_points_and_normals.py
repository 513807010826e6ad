"""Where the surface seen at every pixel lies and which way it faces, for whoever measures on it."""

from __future__ import annotations

import pytest
import torch
from implementations import TORCH64, Implementation, everywhere, in_float32
from scenes import Textured, bumpy_sphere
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn import functional

from tracking3d.rendering import Rendering, render

MEASURED = pytest.mark.parametrize("name", ["points", "normals"])


def drawn(scene: Textured, by: Implementation = TORCH64, **changes: Tensor) -> Rendering:
    arguments = {**scene.arguments(by.dtype), **changes}
    return render(faces=scene.faces, size=scene.size, backend=by.backend, **arguments)


@everywhere
def test_a_point_lies_on_the_ray_of_its_pixel_at_its_depth(by):
    scene = bumpy_sphere((30, 36), views=3)
    result = drawn(scene, by)
    view, row, column = torch.nonzero(result.face_index >= 0, as_tuple=True)
    pixel = (scene.K[view] @ result.points.double()[..., None])[..., 0]
    seen = pixel[:, :2] / pixel[:, 2:]
    atol = 1e-9 if by.exact else 1e-3
    torch.testing.assert_close(seen, torch.stack([column, row], 1).double(), rtol=0, atol=atol)
    torch.testing.assert_close(result.points[:, 2], result.depth.flatten()[result.pixels], rtol=1e-5, atol=0)


@everywhere
def test_a_point_lies_in_the_plane_of_its_face(by):
    result = drawn(bumpy_sphere((30, 36)), by)
    view, row, column = torch.nonzero(result.face_index >= 0, as_tuple=True)
    corner = result.x_cam[view[:, None], result.faces[result.face_index[view, row, column]]]
    normal = functional.normalize(
        torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=1
    )
    assert ((result.points - corner[:, 0]) * normal).sum(1).abs().max() < (1e-12 if by.exact else 1e-5)


@everywhere
def test_normals_are_unit_vectors_that_face_outward(by):
    scene = bumpy_sphere((40, 40), frequency=8)
    result = drawn(scene, by)
    torch.testing.assert_close(result.normals.norm(dim=1), torch.ones(len(result.pixels), dtype=by.dtype))
    ray = functional.normalize(result.points, dim=1)
    assert ((result.normals * ray).sum(1) < 0).double().mean() > 0.97  # all but some at the very outline
    view = torch.nonzero(result.face_index >= 0)[:, 0]
    away = functional.normalize(result.points - scene.t.to(by.dtype)[view], dim=1)
    assert ((result.normals * away).sum(1) > 0.5).all()


@pytest.mark.slow
@MEASURED
def test_gradients_of_points_and_normals_are_those_of_finite_differences(name):
    scene = bumpy_sphere((10, 11), frequency=2)
    leaves = {key: value for key, value in scene.arguments().items() if key in ("vertices", "R", "t", "K")}

    def measured(*values: Tensor) -> Tensor:
        return getattr(drawn(scene, **dict(zip(leaves, values, strict=True))), name)

    # Steps so small that no pixel changes its face: visibility is held fixed.
    assert gradcheck(measured, tuple(leaves.values()), eps=1e-7, atol=1e-5, rtol=1e-4)


@in_float32
@MEASURED
def test_float32_agrees_with_float64(name, by):
    scene = bumpy_sphere((48, 48), frequency=8)
    weight = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    results = []
    for implementation in (by, TORCH64):
        arguments = scene.arguments(implementation.dtype)
        values = getattr(drawn(scene, implementation, **arguments), name)
        (values * weight[: len(values)]).sum().backward()
        grads = {key: leaf.grad.double() for key, leaf in arguments.items() if leaf.grad is not None}
        results.append((values.detach().double(), grads))
    (low, low_grads), (high, high_grads) = results
    torch.testing.assert_close(low, high, rtol=0, atol=1e-5)
    assert set(low_grads) == set(high_grads) == {"vertices", "R", "t", "K"}
    for key, gradient in high_grads.items():
        assert torch.linalg.norm(low_grads[key] - gradient) < 1e-4 * torch.linalg.norm(gradient), key
