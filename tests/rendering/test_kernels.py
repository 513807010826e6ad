"""The Numba kernels against their torch twins: the same bits where the arithmetic is the same, close elsewhere."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from implementations import NUMBA, TORCH32, TORCH64, Implementation
from scenes import Scene, Textured, bumpy_sphere, triangles
from torch import Tensor

from tracking3d.rendering import Rendering, SoftBand, interpolate, rasterize, render, soft_silhouette

BANDS = {
    "DIB-R": SoftBand(),
    "wide": SoftBand(70.0, 0.2),
    "capped": SoftBand(70.0, 0.2, 3),
    "one face": SoftBand(70.0, 0.3, 1),
}
SIZES = [(24, 24), (13, 31), (33, 10), (1, 1), (1, 40), (40, 1), (64, 65)]

every_size = pytest.mark.parametrize("size", SIZES, ids=str)
every_band = pytest.mark.parametrize("band", BANDS.values(), ids=BANDS)


def soup(seed: int, size: tuple[int, int], views: int = 3, spread: float = 0.3) -> Scene:
    """Triangles of which some are degenerate, share vertices, or are behind the camera."""
    scene = triangles(seed, size, views, 30, spread)
    generator = torch.Generator().manual_seed(seed)
    scene.screen[:, 6:9] = scene.screen[:, 6:7]
    scene.depth[:, ::20] -= 2
    faces = torch.cat([scene.faces, torch.randint(90, (30, 3), generator=generator)])
    return replace(scene, faces=faces)


def closed(size: tuple[int, int]) -> Scene:
    return bumpy_sphere(size, views=3, frequency=5).scene


SCENES = {
    **{f"soup {seed}": lambda size, seed=seed: soup(seed, size) for seed in range(3)},
    "tiny triangles": lambda size: soup(7, size, spread=0.02),
    "huge triangles": lambda size: soup(8, size, spread=1.5),
    "closed mesh": closed,
}

every_scene = pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)


def snapped(size: tuple[int, int]) -> Scene:
    """All vertices at pixel centres: rounding decides at every edge."""
    return replace(closed(size), screen=closed(size).screen.round())


def seen(scene: Scene) -> Tensor:
    return rasterize(scene.screen, scene.depth, scene.faces, scene.size, scene.backend).face_index


@every_size
@pytest.mark.parametrize("make", [*SCENES.values(), snapped], ids=[*SCENES, "at pixel centres"])
def test_visibility_is_that_of_torch_bit_for_bit(make, size):
    numba, twin = (
        rasterize(scene.screen, scene.depth, scene.faces, scene.size, scene.backend)
        for scene in (make(size).by(NUMBA), make(size).by(TORCH32))
    )
    assert torch.equal(numba.face_index, twin.face_index)
    assert torch.equal(numba.depth, twin.depth)
    assert torch.equal(numba.pixels, twin.pixels)


@pytest.mark.parametrize("seed", range(40))
def test_visibility_of_any_soup_is_that_of_torch_bit_for_bit(seed):
    scene = soup(seed, (17 + seed, 50 - seed), spread=0.02 * 1.15**seed)
    numba, twin = (
        rasterize(cast.screen, cast.depth, cast.faces, cast.size, cast.backend)
        for cast in (scene.by(NUMBA), scene.by(TORCH32))
    )
    assert torch.equal(numba.face_index, twin.face_index)
    assert torch.equal(numba.depth, twin.depth)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38, 1e30, 1e20, 1e10, 1e5])
def test_visibility_of_absurd_vertices_is_that_of_torch_bit_for_bit(bad):
    for seed in range(20):
        scene = triangles(seed, (20, 22), views=20, faces=5)
        generator = torch.Generator().manual_seed(seed)
        hit = torch.rand(scene.screen.shape, generator=generator) < 0.15
        sign = torch.where(torch.rand(hit.shape, generator=generator) < 0.5, 1, -1)
        scene = replace(scene, screen=torch.where(hit, bad * sign, scene.screen))
        assert torch.equal(seen(scene.by(NUMBA)), seen(scene.by(TORCH32)))


def silhouette(scene: Scene, band: SoftBand, index: Tensor) -> tuple[Tensor, Tensor]:
    """The mask, and the gradient by the vertices of a weighted sum of it; in float64."""
    screen = scene.screen.clone().requires_grad_()
    mask = soft_silhouette(
        screen, scene.depth, scene.faces, index, band.sigma, band.boxlen, band.knum, scene.backend
    )
    generator = torch.Generator().manual_seed(0)
    weight = torch.randn(mask.shape, generator=generator, dtype=torch.float64).to(mask.dtype)
    (mask * weight).sum().backward()
    return mask.detach().double(), screen.grad.double()


def rounding(band: SoftBand) -> float:
    """How far two ways to compute a mask in float32 may lie apart: positions are known to some 1e-7."""
    return max(2e-7 * math.sqrt(band.sigma), 1e-6)


@every_band
@every_size
@every_scene
def test_silhouettes_and_their_gradients_are_those_of_torch(make, size, band):
    scene = make(size)
    index = seen(scene.by(TORCH32))
    mask, gradient = silhouette(scene.by(NUMBA), band, index)
    twin, _ = silhouette(scene.by(TORCH32), band, index)
    _, exact = silhouette(scene.by(TORCH64), band, index)
    torch.testing.assert_close(mask, twin, rtol=0, atol=rounding(band))
    assert torch.linalg.norm(gradient - exact) <= 1e-4 * torch.linalg.norm(exact)


@every_band
@every_size
def test_silhouettes_are_those_of_torch_even_where_rounding_decides_which_edge_is_nearest(size, band):
    scene = snapped(size)
    index = seen(scene.by(TORCH32))
    mask, gradient = silhouette(scene.by(NUMBA), band, index)
    twin, _ = silhouette(scene.by(TORCH32), band, index)
    torch.testing.assert_close(mask, twin, rtol=0, atol=rounding(band))
    assert gradient.isfinite().all()


@pytest.mark.parametrize("size", [(13, 31), (24, 24)], ids=str)
@every_scene
def test_a_band_may_reach_over_the_whole_picture(make, size):
    scene, band = make(size), SoftBand(5.0, 2.0, 1000)
    index = seen(scene.by(TORCH32))
    mask, gradient = silhouette(scene.by(NUMBA), band, index)
    twin, _ = silhouette(scene.by(TORCH32), band, index)
    _, exact = silhouette(scene.by(TORCH64), band, index)
    torch.testing.assert_close(mask, twin, rtol=0, atol=rounding(band))
    assert torch.linalg.norm(gradient - exact) <= 1e-3 * torch.linalg.norm(exact)


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
@every_size
@every_scene
def test_attributes_are_those_of_torch(make, size, channels):
    scene, results = make(size), []
    index = seen(scene.by(TORCH32))
    generator = torch.Generator().manual_seed(1)
    attributes = torch.rand(len(scene.faces), 3, channels, generator=generator)
    for by in (NUMBA, TORCH32, TORCH64):
        cast = scene.by(by)
        leaves = [leaf.to(by.dtype, copy=True) for leaf in (cast.screen, cast.depth, attributes)]
        screen, depth, values = (leaf.requires_grad_() for leaf in leaves)
        result = interpolate(screen, depth, cast.faces, values, index, by.backend)
        weight = torch.linspace(-1, 1, result.numel(), dtype=by.dtype).reshape(result.shape)
        (result * weight).sum().backward()
        results.append([result.detach(), *(leaf.grad for leaf in leaves)])
    numba, twin, exact = ([part.double() for part in parts] for parts in results)
    torch.testing.assert_close(numba[0], twin[0], rtol=0, atol=1e-5)
    for ours, true in zip(numba, exact, strict=True):
        error = torch.linalg.norm(ours - true)
        assert error <= 1e-4 * torch.linalg.norm(true)


def drawn(scene: Textured, by: Implementation, band: SoftBand) -> tuple[Rendering, dict[str, Tensor]]:
    """A rendering, and gradients in float64 of a loss on all of it."""
    arguments = scene.arguments(by.dtype)
    result = render(faces=scene.faces, size=scene.size, band=band, backend=by.backend, **arguments)
    weight = torch.linspace(-1, 1, result.silhouette.numel(), dtype=by.dtype).reshape(result.silhouette.shape)
    loss = (result.silhouette * weight).mean() + (result.image() * weight[:, None]).square().mean()
    loss.backward()
    return result, {name: leaf.grad.double() for name, leaf in arguments.items()}


@pytest.mark.parametrize("band", [SoftBand(), SoftBand(300.0, 0.1)], ids=["DIB-R", "wide"])
@pytest.mark.parametrize(("size", "channels"), [((48, 48), 3), ((40, 64), 5), ((61, 33), 16)], ids=str)
def test_a_rendering_and_its_gradients_are_those_of_torch(size, channels, band):
    scene = bumpy_sphere(size, views=3, frequency=6, channels=channels)
    result, gradients = drawn(scene, NUMBA, band)
    twin, _ = drawn(scene, TORCH32, band)
    exact, true = drawn(scene, TORCH64, band)
    assert torch.equal(result.face_index, twin.face_index)
    assert torch.equal(result.face_index, exact.face_index)  # so that gradients can be compared
    torch.testing.assert_close(result.uv, twin.uv, rtol=0, atol=2e-6)
    torch.testing.assert_close(result.silhouette, twin.silhouette, rtol=0, atol=rounding(band))
    focal = torch.tensor([[1, 0, 0], [0, 1, 0], [0, 0, 0]], dtype=torch.bool)
    gradients["focal length"], true["focal length"] = gradients["K"][:, focal], true["K"][:, focal]
    for name, gradient in true.items():
        assert torch.linalg.norm(gradients[name] - gradient) < 1e-4 * torch.linalg.norm(gradient), name


def test_one_mesh_a_frame_has_the_gradients_of_torch():
    scene = bumpy_sphere((40, 44), views=3, frequency=6)
    grown = torch.tensor([1.0, 0.9, 1.1], dtype=torch.float64)[:, None, None]
    scene = replace(scene, vertices=scene.vertices * grown)
    (_, gradients), (_, true) = (drawn(scene, by, SoftBand()) for by in (NUMBA, TORCH64))
    for name, gradient in true.items():
        assert torch.linalg.norm(gradients[name] - gradient) < 1e-4 * torch.linalg.norm(gradient), name


def stretched(tensor: Tensor) -> Tensor:
    """The same values, none beside the next in memory."""
    apart = tensor.new_zeros(*tensor.shape, 3)
    apart[..., 1] = tensor
    return apart[..., 1]


def test_how_inputs_lie_in_memory_makes_no_difference():
    scene = bumpy_sphere((40, 44), views=3, frequency=6)
    plain, gradients = drawn(scene, NUMBA, SoftBand())
    names = ("vertices", "face_uvs", "texture", "R", "t", "K")
    leaves = {name: stretched(getattr(scene, name).float()).requires_grad_() for name in names}
    for size in (leaf.numel() for leaf in leaves.values()):
        assert size > 1
    faces = stretched(scene.faces)
    assert not faces.is_contiguous() and not leaves["texture"].is_contiguous()
    result = render(faces=faces, size=scene.size, backend="numba", **leaves)
    assert torch.equal(result.silhouette, plain.silhouette)
    assert torch.equal(result.uv, plain.uv)
    weight = torch.linspace(-1, 1, result.silhouette.numel()).reshape(result.silhouette.shape)
    loss = (result.silhouette * weight).mean() + (result.image() * weight[:, None]).square().mean()
    loss.backward()
    for name, leaf in leaves.items():
        torch.testing.assert_close(leaf.grad.double(), gradients[name], rtol=1e-5, atol=1e-7)


def test_gradients_that_lie_anyhow_in_memory_are_taken():
    scene = bumpy_sphere((30, 30)).scene.by(NUMBA)
    index = seen(scene)
    for expand in (True, False):
        screen = scene.screen.clone().requires_grad_()
        mask = soft_silhouette(screen, scene.depth, scene.faces, index, backend="numba")
        uv = interpolate(screen, scene.depth, scene.faces, torch.ones(320, 3, 2), index, backend="numba")
        ones = [torch.ones(()).expand_as(part) if expand else torch.ones_like(part) for part in (mask, uv)]
        torch.autograd.backward([mask, uv], ones)
        if expand:
            first = screen.grad
    assert torch.equal(first, screen.grad)


def test_more_faces_than_count_at_any_pixel_change_nothing():
    scene = triangles(6, (30, 30), views=2, faces=40).by(NUMBA)
    index = seen(scene)
    masks = [silhouette(scene, SoftBand(70.0, 0.2, knum), index) for knum in (40, 41, 10**6)]
    for mask, gradient in masks[1:]:
        assert torch.equal(mask, masks[0][0]) and torch.equal(gradient, masks[0][1])
    assert not torch.equal(silhouette(scene, SoftBand(70.0, 0.2, 5), index)[0], masks[0][0])


@pytest.mark.parametrize("knum", [2**31, 2**32, 10**17, 2**62, 2**63 - 1])
def test_a_cap_may_be_as_large_as_it_likes(knum):
    scene = triangles(6, (30, 30), views=2, faces=40).by(NUMBA)
    index = torch.zeros(2, 30, 30, dtype=torch.long)
    index[:, :10, 5:15] = -1  # 100 pixels: an odd number of them would hide the overflow
    mask, gradient = silhouette(scene, SoftBand(70.0, 0.2, knum), index)
    every, its_gradient = silhouette(scene, SoftBand(70.0, 0.2, 40), index)
    assert torch.equal(mask, every) and torch.equal(gradient, its_gradient)


@pytest.mark.parametrize("depth", [0.00099, 0.001, 0.00101])
def test_a_face_at_the_near_plane_is_drawn_by_both_or_by_none(depth):
    corner = torch.tensor([[[0.0, 0.0], [0.0, 9.0], [9.0, 0.0]]])
    scene = Scene(corner, torch.full((1, 3), depth), torch.tensor([[0, 1, 2]]), (10, 10))
    assert torch.equal(seen(scene.by(NUMBA)), seen(scene.by(TORCH32)))
    empty = torch.full((1, 10, 10), -1)
    masks = [silhouette(scene.by(by), SoftBand(), empty)[0] for by in (NUMBA, TORCH32)]
    torch.testing.assert_close(*masks, rtol=0, atol=rounding(SoftBand()))


def test_kernels_work_without_gradients_and_in_inference_mode():
    scene = bumpy_sphere((30, 30))
    expected, _ = drawn(scene, NUMBA, SoftBand())
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            arguments = {name: leaf.detach() for name, leaf in scene.arguments(torch.float32).items()}
            result = render(faces=scene.faces, size=scene.size, backend="numba", **arguments)
        # Not equal: torch multiplies matrices in another order where nobody asks for gradients.
        torch.testing.assert_close(result.silhouette, expected.silhouette, rtol=0, atol=1e-4)
        torch.testing.assert_close(result.uv, expected.uv, rtol=0, atol=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38])
def test_vertices_that_are_not_finite_crash_nothing_on_the_way_back(bad):
    for seed in range(20):
        scene = soup(seed, (20, 22)).by(NUMBA)
        scene.screen[0, seed % 7 :: 9, seed % 2] = bad
        scene.depth[1, seed % 5 :: 11] = bad
        index = seen(scene)
        leaves = [scene.screen.requires_grad_(), scene.depth.requires_grad_()]
        values = interpolate(*leaves, scene.faces, torch.rand(60, 3, 2), index, "numba")
        mask = soft_silhouette(*leaves, scene.faces, index, 70.0, 0.2, backend="numba")
        (values.sum() + mask.sum()).backward()
        assert leaves[0].grad[2].isfinite().all()


def test_another_default_type_of_torch_makes_no_difference():
    scene = bumpy_sphere((30, 30))
    expected, gradients = drawn(scene, NUMBA, SoftBand())
    torch.set_default_dtype(torch.float64)
    try:
        result, same = drawn(scene, NUMBA, SoftBand())
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(result.silhouette, expected.silhouette)
    assert all(torch.equal(same[name], gradient) for name, gradient in gradients.items())
