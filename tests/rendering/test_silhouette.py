"""DIB-R's soft silhouette against its definition, pixel by pixel, and its gradient."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from render_oracle import soft_mask
from scenes import Scene, bumpy_sphere, triangles
from torch import Tensor
from torch.autograd import gradcheck

from tracking3d.rendering import SoftBand, rasterize, soft_silhouette

WIDE = SoftBand(sigma=70.0, boxlen=0.2)


def covered(scene: Scene) -> Tensor:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size).face_index


def drawn(scene: Scene, band: SoftBand) -> Tensor:
    return soft_silhouette(
        scene.screen, scene.depth, scene.faces, covered(scene), band.sigma, band.boxlen, band.knum
    )


def assert_soft_as_defined(scene: Scene, band: SoftBand) -> None:
    faces, mask = scene.faces.numpy(), (covered(scene) >= 0).numpy()
    expected = [
        soft_mask(screen.numpy(), depth.numpy(), faces, hard, band.sigma, band.boxlen, band.knum)
        for screen, depth, hard in zip(scene.screen, scene.depth, mask, strict=True)
    ]
    np.testing.assert_allclose(drawn(scene, band), np.stack(expected), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("band", [SoftBand(), WIDE, SoftBand(700.0, 0.05)], ids=["DIB-R", "wide", "between"])
@pytest.mark.parametrize("size", [(20, 20), (13, 31), (33, 10)])
@pytest.mark.parametrize("seed", range(2))
def test_random_triangles_front_and_back_are_as_soft_as_defined(seed, size, band):
    assert_soft_as_defined(triangles(seed, size), band)


@pytest.mark.parametrize("spread", [0.01, 3.0])
def test_tiny_and_huge_triangles_are_as_soft_as_defined(spread):
    assert_soft_as_defined(triangles(5, faces=40, spread=spread), WIDE)


@pytest.mark.parametrize("size", [(32, 32), (20, 33)])
def test_a_closed_mesh_is_as_soft_as_defined(size):
    assert_soft_as_defined(bumpy_sphere(size, views=1).scene, SoftBand(500.0, 0.07))


def test_a_mesh_partly_outside_the_picture_is_as_soft_as_defined():
    scene = bumpy_sphere((24, 24), views=1).scene
    outside = Scene(scene.screen + torch.tensor([13.0, -9.0]), scene.depth, scene.faces, scene.size)
    assert_soft_as_defined(outside, WIDE)


@pytest.mark.parametrize("knum", [1, 3, 8])
def test_only_the_first_faces_in_index_order_count(knum):
    scene = triangles(6, views=2, faces=30)
    band = SoftBand(70.0, 0.2, knum)
    assert_soft_as_defined(scene, band)
    assert not torch.equal(drawn(scene, band), drawn(scene, WIDE))


def test_the_cap_of_thirty_faces_is_reached_and_kept():
    faces = 40
    scene = triangles(9, views=1, faces=faces, spread=0.02)
    # All of them outside the pixel (10, 10), each a little farther than the one before.
    corner = torch.tensor([[10.6, 10.0], [12.0, 11.0], [12.0, 9.0]], dtype=torch.float64)
    shift = 0.02 * torch.arange(faces, dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0.0])
    scene.screen[0] = (corner + shift).reshape(-1, 2)
    assert_soft_as_defined(scene, SoftBand(500.0, 0.3))
    capped, all_faces = drawn(scene, SoftBand(500.0, 0.3, 30)), drawn(scene, SoftBand(500.0, 0.3, faces))
    assert (capped[0, 10, 10] < all_faces[0, 10, 10]).item()


def test_a_face_counts_from_the_lower_end_of_its_box_up_to_but_not_at_the_upper():
    # In a picture of 4 pixels a pixel's width is half an NDC unit: 0.5 of reach is exactly one pixel.
    screen = torch.tensor([[[1.0, 1.0], [1.0, 2.0], [2.0, 1.0]]], dtype=torch.float64)
    scene = Scene(screen, torch.ones(1, 3, dtype=torch.float64), torch.tensor([[0, 2, 1]]), (4, 4))
    mask = drawn(scene, SoftBand(0.1, 0.5))
    assert (mask[0] > 0).tolist() == [[True] * 3 + [False]] * 3 + [[False] * 4]


def test_faces_seen_from_behind_count():
    scene = Scene(
        torch.tensor([[[4.0, 4.0], [9.0, 4.0], [4.0, 9.0]]]),
        torch.ones(1, 3),
        torch.tensor([[0, 1, 2]]),
        (16, 16),
    )
    assert (covered(scene) == -1).all()
    assert drawn(scene, SoftBand()).max() > 0.9


def test_faces_with_a_vertex_before_the_near_plane_do_not_count():
    scene = triangles(1, views=1)
    scene.depth[0, ::9] = -1.0
    assert_soft_as_defined(scene, WIDE)


def test_degenerate_faces_count_as_the_line_or_point_that_they_are():
    scene = triangles(3, views=1, faces=3, spread=0.1)
    scene.screen[0, 0:3] = torch.tensor([[2.0, 3.1], [10.0, 3.1], [18.0, 3.1]])
    scene.screen[0, 3:6] = torch.tensor([12.0, 12.3])
    assert_soft_as_defined(scene, WIDE)
    screen = scene.screen.clone().requires_grad_()
    soft_silhouette(screen, scene.depth, scene.faces, covered(scene), 70.0, 0.2).sum().backward()
    assert screen.grad.isfinite().all()


def test_covered_pixels_are_one_and_pull_at_nothing():
    scene = bumpy_sphere((24, 24)).scene
    index = covered(scene)
    screen = scene.screen.clone().requires_grad_()
    mask = soft_silhouette(screen, scene.depth, scene.faces, index)
    assert (mask[index >= 0] == 1).all()
    mask[index >= 0].sum().backward()
    assert (screen.grad == 0).all()


def test_a_pixel_on_the_edge_of_a_back_face_has_a_finite_gradient():
    scene = Scene(
        torch.tensor([[[4.0, 4.0], [9.0, 4.0], [4.0, 9.0]]], requires_grad=True),
        torch.ones(1, 3),
        torch.tensor([[0, 1, 2]]),
        (16, 16),
    )
    mask = drawn(scene, SoftBand())
    assert mask[0, 4, 6].item() == pytest.approx(1.0)
    mask.sum().backward()
    assert scene.screen.grad.isfinite().all()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_vertex_that_is_not_finite_makes_its_view_nan_and_no_other(bad):
    scene = triangles(4, views=3, faces=6)
    index, whole = covered(scene), drawn(scene, WIDE)
    scene.screen[1, 2] = bad
    mask = soft_silhouette(scene.screen, scene.depth, scene.faces, index, 70.0, 0.2)
    assert mask[1][index[1] < 0].isnan().all()
    assert torch.equal(mask[::2], whole[::2])


def test_a_vertex_far_outside_the_picture_is_nothing_special():
    scene = triangles(4, views=1, faces=6)
    scene.screen[0, 1] = 1e6
    assert_soft_as_defined(scene, WIDE)


@pytest.mark.parametrize(
    ("scene", "band"),
    [
        (triangles(2, (11, 14), faces=8), WIDE),
        (triangles(2, (11, 14), faces=8), SoftBand(70.0, 0.2, 3)),
        (bumpy_sphere((16, 16), frequency=2).scene, SoftBand(700.0, 0.06)),
    ],
    ids=["triangles", "capped", "closed mesh"],
)
def test_the_gradient_by_the_vertices_is_that_of_finite_differences(scene, band):
    index = covered(scene)

    def mask(screen: Tensor) -> Tensor:
        return soft_silhouette(screen, scene.depth, scene.faces, index, band.sigma, band.boxlen, band.knum)

    assert gradcheck(mask, scene.screen.clone().requires_grad_(), eps=1e-7, atol=1e-4, rtol=1e-4)


def test_a_missing_pixel_pulls_the_outline_towards_it():
    scene = bumpy_sphere((32, 32), views=1).scene
    screen = scene.screen.clone().requires_grad_()
    mask = soft_silhouette(screen, scene.depth, scene.faces, covered(scene), 500.0, 0.1)
    row = int(scene.screen[0, :, 1].mean())
    right = int(scene.screen[0, :, 0].max()) + 2
    (-mask[0, row, right]).backward()
    step = -screen.grad.sum((0, 1))
    assert step[0] > 0 and abs(step[1]) < step[0]


def test_float32_agrees_with_float64():
    scene = bumpy_sphere((48, 48), frequency=8).scene
    index = covered(scene)
    results = []
    for dtype in (torch.float32, torch.float64):
        screen = scene.screen.to(dtype).requires_grad_()
        mask = soft_silhouette(screen, scene.depth.to(dtype), scene.faces, index)
        (mask**2).sum().backward()
        results.append((mask.double(), screen.grad.double()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-4)
    assert torch.linalg.norm(results[0][1] - results[1][1]) < 1e-3 * torch.linalg.norm(results[1][1])
