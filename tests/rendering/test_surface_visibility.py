"""Which vertices and texels are seen, against ray casting, and what a rendering tells about its surface."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import Textured, bumpy_sphere
from torch import Tensor

from tracking3d.geometry.mesh import vertex_normals
from tracking3d.rendering import (
    Rendering,
    TexelMap,
    channels_last,
    render,
    sample_texture,
    visible_texels,
    visible_vertices,
)

BACKENDS = [("torch", torch.float64), ("torch", torch.float32), ("numba", torch.float32)]


def drawn(scene: Textured, backend: str, dtype: torch.dtype) -> Rendering:
    return render(faces=scene.faces, size=scene.size, backend=backend, **scene.arguments(dtype))


def hidden_share(x_cam: Tensor, faces: Tensor, points: Tensor) -> np.ndarray:
    """For each point, whether a face crosses the way from the camera (the origin) to it; brute force."""
    corners = x_cam[faces].numpy()
    hidden = np.zeros(len(points), bool)
    for face in corners:
        c = np.linalg.solve(face.T + 1e-12 * np.eye(3), points.numpy().T)  # point = c . corners
        total = c.sum(0)
        hidden |= (c > 1e-9).all(0) & (total > 1 + 1e-6)
    return hidden


@pytest.mark.parametrize(("backend", "dtype"), BACKENDS)
def test_seen_vertices_are_those_that_a_ray_reaches(backend, dtype):
    scene = bumpy_sphere((90, 96), frequency=6)
    result = drawn(scene, backend, dtype)
    seen = visible_vertices(result)
    for view in range(2):
        x_cam = result.x_cam[view].detach().double()
        expected = ~hidden_share(x_cam, scene.faces, x_cam)
        wrong = expected != seen[view].numpy()
        assert 0.2 < expected.mean() < 0.7
        # Vertices on the rim are seen at a grazing angle, a pixel this way or that.
        normal = vertex_normals(x_cam, scene.faces)
        grazing = (normal * torch.nn.functional.normalize(x_cam, dim=1)).sum(1).abs() < 0.3
        assert not (wrong & ~grazing.numpy()).any()


@pytest.mark.parametrize(("backend", "dtype"), BACKENDS)
def test_seen_texels_are_those_that_a_ray_reaches(backend, dtype):
    scene = bumpy_sphere((90, 96), frequency=4)
    result = drawn(scene, backend, dtype)
    texels = TexelMap.of(scene.face_uvs.to(dtype), 24)
    seen = visible_texels(result, texels)
    for view in range(2):
        x_cam = result.x_cam[view].detach().double()
        corners = x_cam[scene.faces[texels.face]]
        points = (corners * texels.barycentric.double()[..., None]).sum(1)
        expected = ~hidden_share(x_cam, scene.faces, points)
        assert 0.2 < expected.mean() < 0.7
        assert (expected != seen[view].numpy()).mean() < 0.04


def test_nothing_is_seen_outside_the_window_or_behind_the_camera():
    scene = bumpy_sphere()
    for t in ([0.0, 0.0, -3.5], [40.0, 0.0, 3.5]):
        moved = scene.arguments()
        moved["t"] = torch.tensor([t, t], dtype=torch.float64)
        result = render(faces=scene.faces, size=scene.size, **moved)
        assert not visible_vertices(result).any()
        assert not visible_texels(result, TexelMap.of(scene.face_uvs, 16)).any()


@pytest.mark.parametrize(("backend", "dtype"), BACKENDS)
def test_surface_points_lie_on_their_pixels_rays_at_the_drawn_depth(backend, dtype):
    scene = bumpy_sphere((30, 36))
    result = drawn(scene, backend, dtype)
    covered = result.face_index >= 0
    torch.testing.assert_close(result.points[:, 2], result.depth[covered], rtol=1e-4, atol=1e-5)
    view, row, column = torch.nonzero(covered, as_tuple=True)
    pixel = (result.K[view] @ result.points[..., None])[..., 0]
    expected = torch.stack([column, row], 1).to(dtype)
    torch.testing.assert_close(pixel[:, :2] / pixel[:, 2:], expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize(("backend", "dtype"), BACKENDS)
def test_normals_of_a_ball_point_away_from_its_centre(backend, dtype):
    scene = bumpy_sphere((40, 40), frequency=12)
    arguments = scene.arguments(dtype)
    ball = torch.nn.functional.normalize(scene.vertices, dim=1).to(dtype)
    result = render(faces=scene.faces, size=scene.size, backend=backend, **(arguments | {"vertices": ball}))
    centre = scene.t.to(dtype)[result.pixels // (40 * 40)]
    outward = torch.nn.functional.normalize(result.points - centre, dim=1)
    assert (result.normals * outward).sum(1).min() > 0.999
    torch.testing.assert_close(result.normals.norm(dim=1), torch.ones(len(outward), dtype=dtype))


def test_values_of_pixels_become_an_image():
    scene = bumpy_sphere((20, 22))
    result = drawn(scene, "torch", torch.float64)
    image = result.image(result.points)
    assert image.shape == (2, 3, 20, 22)
    covered = result.face_index >= 0
    assert torch.equal(image.permute(0, 2, 3, 1)[covered], result.points)
    assert (image.permute(0, 2, 3, 1)[~covered] == 0).all()


def test_what_is_not_asked_for_is_not_computed():
    result = drawn(bumpy_sphere(), "torch", torch.float64)
    assert not {"features", "points", "normals"} & set(vars(result))
    assert result.features is result.features


def test_vertex_normals_of_a_tetrahedron_are_averages_weighted_by_area():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    normals = vertex_normals(vertices, faces)
    at_origin = torch.tensor([-6.0, -3.0, -2.0])  # of the three faces at it, by twice their areas
    torch.testing.assert_close(normals[0], at_origin / at_origin.norm())
    assert (normals[4] == 0).all()  # no face has it
    both = vertex_normals(torch.stack([vertices, 2 * vertices]), faces)
    torch.testing.assert_close(both[1], normals)


def test_the_memory_format_changes_no_value():
    texture = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(0))
    packed = channels_last(texture)
    assert torch.equal(packed, texture) and packed.shape == texture.shape
    assert packed.stride() == (1, 21, 3)
    uv = torch.rand(10, 2)
    assert torch.equal(sample_texture(packed, uv), sample_texture(texture, uv))
