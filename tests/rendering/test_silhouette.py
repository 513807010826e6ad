"""DIB-R's soft silhouette against its definition, pixel by pixel, and its gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from implementations import TORCH64, everywhere, in_float32
from render_oracle import soft_mask
from scenes import Scene, bumpy_sphere, rounded, triangles
from torch import Tensor
from torch.autograd import gradcheck

from tracking3d.rendering import SoftBand, rasterize, soft_silhouette

WIDE = SoftBand(sigma=70.0, boxlen=0.2)


def covered(scene: Scene) -> Tensor:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size, scene.backend).face_index


def drawn(scene: Scene, band: SoftBand, index: Tensor | None = None) -> Tensor:
    index = covered(scene) if index is None else index
    return soft_silhouette(
        scene.screen,
        scene.depth,
        scene.faces,
        index,
        band.sigma,
        band.boxlen,
        band.knum,
        scene.backend,
    )


def assert_soft_as_defined(scene: Scene, band: SoftBand) -> None:
    index = covered(scene)
    kernel = band.sigma, band.boxlen, band.knum
    expected = [
        soft_mask(screen.numpy(), depth.numpy(), scene.faces.numpy(), hard.numpy(), *kernel)
        for screen, depth, hard in zip(scene.screen.double(), scene.depth.double(), index >= 0, strict=True)
    ]
    exact = scene.screen.dtype == torch.float64
    close = {"rtol": 1e-6, "atol": 1e-7} if exact else {"rtol": 0, "atol": 3e-5}
    np.testing.assert_allclose(drawn(scene, band, index), np.stack(expected), **close)


@everywhere
@pytest.mark.parametrize("band", [SoftBand(), WIDE, SoftBand(700.0, 0.05)], ids=["DIB-R", "wide", "between"])
@pytest.mark.parametrize("size", [(20, 20), (13, 31), (33, 10)])
@pytest.mark.parametrize("seed", range(2))
def test_random_triangles_front_and_back_are_as_soft_as_defined(seed, size, band, by):
    assert_soft_as_defined(triangles(seed, size).by(by), band)


@everywhere
@pytest.mark.parametrize("spread", [0.01, 3.0])
def test_tiny_and_huge_triangles_are_as_soft_as_defined(spread, by):
    assert_soft_as_defined(triangles(5, faces=40, spread=spread).by(by), WIDE)


@everywhere
@pytest.mark.parametrize("size", [(32, 32), (20, 33)])
def test_a_closed_mesh_is_as_soft_as_defined(size, by):
    assert_soft_as_defined(bumpy_sphere(size, views=1).scene.by(by), SoftBand(500.0, 0.07))


@everywhere
def test_a_mesh_partly_outside_the_picture_is_as_soft_as_defined(by):
    scene = bumpy_sphere((24, 24), views=1).scene
    moved = rounded(scene.screen + torch.tensor([13.0, -9.0]))
    assert_soft_as_defined(replace(scene, screen=moved).by(by), WIDE)


@everywhere
@pytest.mark.parametrize("knum", [1, 3, 8])
def test_only_the_first_faces_in_index_order_count(knum, by):
    scene = triangles(6, views=2, faces=30).by(by)
    band = SoftBand(70.0, 0.2, knum)
    assert_soft_as_defined(scene, band)
    assert not torch.equal(drawn(scene, band), drawn(scene, WIDE))


@everywhere
def test_the_cap_of_thirty_faces_is_reached_and_kept(by):
    faces = 40
    scene = triangles(9, views=1, faces=faces, spread=0.02)
    # All of them outside the pixel (10, 10), each a little farther than the one before.
    corner = torch.tensor([[10.6, 10.0], [12.0, 11.0], [12.0, 9.0]], dtype=torch.float64)
    shift = 0.02 * torch.arange(faces, dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0.0])
    scene = replace(scene, screen=rounded((corner + shift).reshape(1, -1, 2))).by(by)
    assert_soft_as_defined(scene, SoftBand(500.0, 0.3))
    capped, all_faces = drawn(scene, SoftBand(500.0, 0.3, 30)), drawn(scene, SoftBand(500.0, 0.3, faces))
    assert (capped[0, 10, 10] < all_faces[0, 10, 10]).item()


@everywhere
def test_a_face_counts_from_the_lower_end_of_its_box_up_to_but_not_at_the_upper(by):
    # In a picture of 4 pixels a pixel's width is half an NDC unit: 0.5 of reach is exactly one pixel.
    screen = torch.tensor([[[1.0, 1.0], [1.0, 2.0], [2.0, 1.0]]], dtype=torch.float64)
    scene = Scene(screen, torch.ones(1, 3, dtype=torch.float64), torch.tensor([[0, 2, 1]]), (4, 4)).by(by)
    mask = drawn(scene, SoftBand(0.1, 0.5))
    assert (mask[0] > 0).tolist() == [[True] * 3 + [False]] * 3 + [[False] * 4]


def back_face() -> Scene:
    screen = torch.tensor([[[4.0, 4.0], [9.0, 4.0], [4.0, 9.0]]], dtype=torch.float64)
    return Scene(screen, torch.ones(1, 3, dtype=torch.float64), torch.tensor([[0, 1, 2]]), (16, 16))


@everywhere
def test_faces_seen_from_behind_count(by):
    scene = back_face().by(by)
    assert (covered(scene) == -1).all()
    assert drawn(scene, SoftBand()).max() > 0.9


@everywhere
def test_faces_with_a_vertex_before_the_near_plane_do_not_count(by):
    scene = triangles(1, views=1).by(by)
    scene.depth[0, ::9] = -1.0
    assert_soft_as_defined(scene, WIDE)


@everywhere
def test_degenerate_faces_count_as_the_line_or_point_that_they_are(by):
    scene = triangles(3, views=1, faces=3, spread=0.1).by(by)
    scene.screen[0, 0:3] = torch.tensor([[2.0, 3.125], [10.0, 3.125], [18.0, 3.125]])
    scene.screen[0, 3:6] = torch.tensor([12.0, 12.25])
    assert_soft_as_defined(scene, WIDE)
    scene.screen.requires_grad_()
    drawn(scene, WIDE).sum().backward()
    assert scene.screen.grad.isfinite().all()


@everywhere
def test_no_faces_at_all_leave_the_silhouette_empty(by):
    scene = triangles(3, (5, 7)).by(by)
    scene = replace(scene, faces=scene.faces[:0], screen=scene.screen.requires_grad_())
    mask = drawn(scene, WIDE)
    assert mask.shape == (2, 5, 7) and (mask == 0).all()
    mask.sum().backward()
    assert (scene.screen.grad == 0).all()


@everywhere
def test_one_view_is_as_soft_as_among_others(by):
    scene = triangles(4, views=3).by(by)
    together = drawn(scene, WIDE)
    for view in range(3):
        one = slice(view, view + 1)
        alone = drawn(replace(scene, screen=scene.screen[one], depth=scene.depth[one]), WIDE)
        torch.testing.assert_close(alone, together[one], rtol=0, atol=1e-6)


@everywhere
def test_covered_pixels_are_one_and_pull_at_nothing(by):
    scene = bumpy_sphere((24, 24)).scene.by(by)
    index = covered(scene)
    scene.screen.requires_grad_()
    mask = drawn(scene, SoftBand(), index)
    assert (mask[index >= 0] == 1).all()
    mask[index >= 0].sum().backward()
    assert (scene.screen.grad == 0).all()


@everywhere
def test_a_pixel_on_the_edge_of_a_back_face_has_a_finite_gradient(by):
    scene = back_face().by(by)
    scene.screen.requires_grad_()
    mask = drawn(scene, SoftBand())
    assert mask[0, 4, 6].item() == pytest.approx(1.0)
    mask.sum().backward()
    assert scene.screen.grad.isfinite().all()


@everywhere
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_vertex_that_is_not_finite_makes_its_view_nan_and_no_other(bad, by):
    scene = triangles(4, views=3, faces=6).by(by)
    index, whole = covered(scene), drawn(scene, WIDE)
    scene.screen[1, 2] = bad
    mask = drawn(scene, WIDE, index)
    assert mask[1][index[1] < 0].isnan().all()
    assert torch.equal(mask[::2], whole[::2])


@everywhere
def test_a_vertex_far_outside_the_picture_is_nothing_special(by):
    scene = triangles(4, views=1, faces=6)
    scene.screen[0, 1] = 1e6 if by.exact else 300  # float32 knows an edge to a millionth of its length
    assert_soft_as_defined(scene.by(by), WIDE)


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
        return drawn(replace(scene, screen=screen), band, index)

    assert gradcheck(mask, scene.screen.clone().requires_grad_(), eps=1e-7, atol=1e-4, rtol=1e-4)


@everywhere
def test_a_missing_pixel_pulls_the_outline_towards_it(by):
    scene = bumpy_sphere((32, 32), views=1).scene.by(by)
    row = int(scene.screen[0, :, 1].mean())
    right = int(scene.screen[0, :, 0].max()) + 2
    scene.screen.requires_grad_()
    (-drawn(scene, SoftBand(500.0, 0.1))[0, row, right]).backward()
    step = -scene.screen.grad.sum((0, 1))
    assert step[0] > 0 and abs(step[1]) < step[0]


@in_float32
@pytest.mark.parametrize("band", [SoftBand(), WIDE, SoftBand(70.0, 0.2, 5)], ids=["DIB-R", "wide", "capped"])
def test_float32_agrees_with_float64(band, by):
    scene = bumpy_sphere((48, 48), frequency=8).scene
    index = covered(scene)
    results = []
    for implementation in (by, TORCH64):
        cast = scene.by(implementation)
        screen = cast.screen.clone().requires_grad_()
        mask = drawn(replace(cast, screen=screen), band, index)
        (mask**2).sum().backward()
        results.append((mask.double(), screen.grad.double()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=3e-5)
    assert torch.linalg.norm(results[0][1] - results[1][1]) < 1e-4 * torch.linalg.norm(results[1][1])


@everywhere
@pytest.mark.parametrize("knum", [0, -1])
def test_at_least_one_face_counts(by, knum):
    scene = triangles(1).by(by)
    index = torch.full((2, 24, 24), -1)
    with pytest.raises(ValueError, match=f"knum is {knum}; give"):
        soft_silhouette(scene.screen, scene.depth, scene.faces, index, knum=knum, backend=by.backend)
