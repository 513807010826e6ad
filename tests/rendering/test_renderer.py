"""The renderer as a whole: projection, gradients through every input, windows of one camera, clear refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from implementations import TORCH64, Implementation, everywhere, in_float32
from render_oracle import cast_rays
from scenes import Textured, bumpy_sphere
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn import functional

from tracking3d.geometry.camera import Camera, Window
from tracking3d.rendering import Rendering, SoftBand, project, render, sample_texture

WIDE = SoftBand(sigma=300.0, boxlen=0.1)


def drawn(
    scene: Textured, band: SoftBand | None = None, by: Implementation = TORCH64, **changes: Tensor
) -> Rendering:
    arguments = {**scene.arguments(by.dtype), **changes}
    return render(faces=scene.faces, size=scene.size, band=band, backend=by.backend, **arguments)


def test_vertices_are_projected_by_the_pinhole_formula():
    scene = bumpy_sphere(views=3)
    screen, depth = project(scene.vertices, scene.R, scene.t, scene.K)
    for view in range(3):
        R, t, K = (matrix[view].numpy() for matrix in (scene.R, scene.t, scene.K))
        for vertex, point in enumerate(scene.vertices.numpy()[::40]):
            x_cam = R @ point + t
            pixel = K @ x_cam / x_cam[2]
            np.testing.assert_allclose(screen[view, 40 * vertex], pixel[:2])
            np.testing.assert_allclose(depth[view, 40 * vertex], x_cam[2])


@everywhere
def test_the_image_is_the_texture_where_the_rays_meet_the_surface(by):
    scene = bumpy_sphere((30, 36))
    result = drawn(scene, by=by)
    screen, depth = project(scene.vertices, scene.R, scene.t, scene.K)
    faces, uvs = scene.faces.numpy(), scene.face_uvs.numpy()
    pictures = [
        cast_rays(s.numpy(), d.numpy(), faces, scene.size) for s, d in zip(screen, depth, strict=True)
    ]
    uv = np.concatenate([picture.interpolate(uvs) for picture in pictures])
    atol = 1e-9 if by.exact else 1e-4
    np.testing.assert_allclose(result.uv.detach(), uv, atol=atol)
    np.testing.assert_allclose(
        result.features.detach(), sample_texture(scene.texture, torch.tensor(uv)), atol=atol
    )
    mask = np.stack([picture.face_index >= 0 for picture in pictures])
    assert np.array_equal(result.pixels, np.flatnonzero(mask))
    image = result.image().detach().numpy()
    assert image.shape == (2, 3, 30, 36)
    assert np.array_equal(image.transpose(0, 2, 3, 1)[mask], result.features.detach())
    assert (image.transpose(0, 2, 3, 1)[~mask] == 0).all()


@everywhere
def test_a_whole_turn_of_the_texture_coordinates_changes_nothing(by):
    scene = bumpy_sphere((30, 36))
    assert scene.face_uvs[..., 0].max() > 1  # faces across the seam
    expected = drawn(scene, by=by).image()
    for turns in (-2.0, 1.0):
        uvs = (scene.face_uvs + torch.tensor([turns, 0.0])).to(by.dtype)
        atol = 1e-9 if by.exact else 1e-5
        torch.testing.assert_close(drawn(scene, by=by, face_uvs=uvs).image(), expected, rtol=0, atol=atol)


def nth(scene: Textured, view: int) -> Textured:
    """One view of the scene alone."""
    one = slice(view, view + 1)
    return replace(scene, R=scene.R[one], t=scene.t[one], K=scene.K[one])


@everywhere
def test_one_mesh_a_frame_is_rendered_like_each_mesh_alone(by):
    scene = bumpy_sphere(views=2)
    vertices = torch.stack([scene.vertices, 0.7 * scene.vertices + 0.1])
    both = drawn(scene, by=by, vertices=vertices.to(by.dtype))
    for view in range(2):
        alone = drawn(replace(nth(scene, view), vertices=vertices[view]), by=by)
        torch.testing.assert_close(alone.image()[0], both.image()[view])
        torch.testing.assert_close(alone.silhouette[0], both.silhouette[view])


@everywhere
def test_frames_with_windows_of_their_own_are_rendered_like_each_alone(by):
    camera = Camera.from_fov(160, 120, 40.0)
    windows = [
        Window(20, 10, 90, 48),
        Window(-30, 0, 150, 48),
        Window(60, 40, 33, 48),
        Window(45, 25, 70, 48),
    ]
    K = torch.stack([torch.tensor(window.K(camera)) for window in windows])
    scene = replace(bumpy_sphere((48, 48), views=4), K=K)
    together = drawn(scene, WIDE, by)
    assert (together.face_index >= 0).flatten(1).any(1).all()
    for view in range(4):
        alone = drawn(nth(scene, view), WIDE, by)
        assert torch.equal(alone.face_index[0], together.face_index[view])
        torch.testing.assert_close(alone.image()[0], together.image()[view])
        torch.testing.assert_close(alone.silhouette[0], together.silhouette[view])


@everywhere
def test_a_mesh_behind_the_camera_or_outside_the_picture_leaves_it_empty(by):
    scene = bumpy_sphere()
    for t in ([0.0, 0.0, -3.5], [40.0, 0.0, 3.5], [0.0, 0.0, 0.5]):  # the camera is inside of the last
        result = drawn(scene, by=by, t=torch.tensor([t, t], dtype=by.dtype).requires_grad_())
        assert result.pixels.numel() == 0
        assert result.features.shape == (0, 3)
        assert (result.image() == 0).all()
        (result.silhouette.sum() + result.features.sum()).backward()


@everywhere
def test_no_faces_at_all_leave_the_picture_empty(by):
    scene = bumpy_sphere()
    result = drawn(replace(scene, faces=scene.faces[:0], face_uvs=scene.face_uvs[:0]), by=by)
    assert (result.silhouette == 0).all() and (result.image() == 0).all()
    (result.silhouette.sum() + result.features.sum()).backward()


@everywhere
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_pose_that_is_not_finite_shows_in_its_own_frame_only(bad, by):
    scene = bumpy_sphere(views=3)
    whole = drawn(scene, by=by)
    t = scene.t.to(by.dtype).clone()
    t[1, 0] = bad
    result = drawn(scene, by=by, t=t)
    assert result.silhouette[1].isnan().all()
    assert torch.equal(result.silhouette[::2], whole.silhouette[::2])
    torch.testing.assert_close(result.image()[::2], whole.image()[::2])


@everywhere
def test_the_same_scene_gives_the_same_bits_and_gradients(by):
    scene = bumpy_sphere((48, 48), frequency=6)

    def once() -> list[Tensor]:
        arguments = scene.arguments(by.dtype)
        result = render(faces=scene.faces, size=scene.size, backend=by.backend, **arguments)
        (result.silhouette.square().mean() + result.features.square().mean()).backward()
        return [result.silhouette.detach(), result.features.detach(), *(a.grad for a in arguments.values())]

    assert all(torch.equal(a, b) for a, b in zip(once(), once(), strict=True))


@everywhere
def test_second_derivatives_are_refused_and_not_wrong(by):
    result = drawn(bumpy_sphere((20, 20), frequency=2), by=by)
    for values in (result.silhouette, result.uv):
        (slope,) = torch.autograd.grad(values.square().sum(), result.screen, create_graph=True)
        with pytest.raises(RuntimeError, match="once_differentiable"):
            slope.sum().backward()


def test_gradients_by_every_input_are_those_of_finite_differences():
    scene = bumpy_sphere((11, 12), frequency=1, texture=6, channels=2)
    arguments = scene.arguments()

    def outputs(*values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        result = drawn(scene, WIDE, **dict(zip(arguments, values, strict=True)))
        return result.silhouette, result.features, result.uv

    index = drawn(scene, WIDE).face_index
    assert len(index.unique()) > 10
    # Steps so small that no pixel changes its face: visibility is held fixed.
    assert gradcheck(outputs, tuple(arguments.values()), eps=1e-7, atol=1e-4, rtol=1e-3)


def inner_pixels(scene: Textured, steps: list[dict[str, Tensor]]) -> Tensor:
    """Pixels three or more inside the outline in all of the renderings, ``(B, H, W)`` bool."""
    inside = torch.stack([drawn(scene, **step).face_index >= 0 for step in steps]).all(0)
    return -functional.max_pool2d(-inside.float()[:, None], 5, 1, 2)[:, 0] > 0


@everywhere
@pytest.mark.parametrize("name", ["vertices", "face_uvs", "texture", "R", "t", "K"])
def test_an_image_loss_falls_as_its_gradient_says_inside_of_the_outline(name, by):
    """Finite differences of the loss in float64: faces trade pixels, only the outline's band is left out."""
    scene = bumpy_sphere((40, 40), frequency=6, texture=96)
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(2, 3, 40, 40, generator=generator, dtype=torch.float64)
    value = getattr(scene, name)
    direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
    if name == "K":
        direction[:, 2] = direction[:, :, :2].triu(1)[:, 1:2, 0:1] = 0  # the entries that are constants
    step = 3e-6 * direction
    steps = [{name: value}, {name: value + step}, {name: value - step}]
    inside = inner_pixels(scene, steps)
    assert inside.float().mean() > 0.15

    def loss(by: Implementation = TORCH64, **changes: Tensor) -> Tensor:
        difference = (drawn(scene, by=by, **changes).image() - target).square().sum(1)
        return difference[inside].mean()

    leaf = value.to(by.dtype, copy=True).requires_grad_()
    loss(by, **{name: leaf}).backward()
    slope = (leaf.grad * direction).sum()
    measured = (loss(**steps[1]) - loss(**steps[2])) / 6e-6
    assert slope.item() == pytest.approx(measured.item(), rel=2e-3, abs=1e-6)


@in_float32
def test_float32_agrees_with_float64(by):
    scene = bumpy_sphere((64, 64), frequency=8)
    results = []
    for implementation in (by, TORCH64):
        arguments = scene.arguments(implementation.dtype)
        result = drawn(scene, by=implementation, **arguments)
        loss = (result.image() - 0.3).square().mean() + (result.silhouette - 0.5).square().mean()
        loss.backward()
        results.append((result, {name: tensor.grad.double() for name, tensor in arguments.items()}))
    (low, low_grad), (high, high_grad) = results
    assert torch.equal(low.face_index, high.face_index)
    torch.testing.assert_close(low.image().double(), high.image(), rtol=0, atol=1e-5)
    torch.testing.assert_close(low.silhouette.double(), high.silhouette, rtol=0, atol=5e-5)
    for name, gradient in high_grad.items():
        error = torch.linalg.norm(low_grad[name] - gradient) / torch.linalg.norm(gradient)
        assert error < 1e-4, name


def matrix(K: np.ndarray) -> Tensor:
    return torch.tensor(K)[None]


def test_points_through_a_window_are_the_frames_points_seen_from_its_corner():
    camera = Camera(310.0, 290.0, 78.2, 61.7, 160, 120)
    scene = bumpy_sphere(views=1)
    full, depth = project(scene.vertices, scene.R, scene.t, matrix(camera.K))
    for window in (Window(20, 10, 64, 64), Window(-30, 50, 90, 128), Window(7, -5, 99, 33)):
        screen, same_depth = project(scene.vertices, scene.R, scene.t, matrix(window.K(camera)))
        corner = torch.tensor([window.left, window.top])
        torch.testing.assert_close(screen, (full + 0.5 - corner) * window.size / window.side - 0.5)
        assert torch.equal(depth, same_depth)


@everywhere
@pytest.mark.parametrize("every", [1, 3])
def test_a_window_is_what_the_full_camera_sees_there(every, by):
    camera = Camera.from_fov(90, 90, 40.0)
    side, left, top = 48, 12, 30
    scene = replace(bumpy_sphere((90, 90), views=1), K=matrix(camera.K))
    window = Window(left, top, side, side // every)
    # The band is defined in NDC: a window of half the side doubles a distance, so the kernel follows.
    ratio = side / 90
    crop = drawn(
        replace(scene, K=matrix(window.K(camera)), size=(window.size, window.size)),
        SoftBand(WIDE.sigma * ratio**2, WIDE.boxlen / ratio, 1000),
        by,
    )
    full = drawn(scene, SoftBand(WIDE.sigma, WIDE.boxlen, 1000), by)
    middle = every // 2  # the centre of a window's pixel is that of the middle one of the frame's
    region = (..., slice(top + middle, top + side, every), slice(left + middle, left + side, every))
    assert torch.equal(crop.face_index, full.face_index[region])
    assert 0.2 < (crop.face_index >= 0).float().mean() < 0.9
    close = {} if by.exact else {"rtol": 1e-5, "atol": 1e-4}
    torch.testing.assert_close(crop.image(), full.image()[region], **close)
    torch.testing.assert_close(crop.depth, full.depth[region], **close)
    torch.testing.assert_close(crop.silhouette, full.silhouette[region], **close)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"vertices": (162, 2)}, r"vertices.*\(162, 2\).*\(V, 3\)"),
        ({"vertices": (3, 162, 3)}, r"vertices.*\(3, 162, 3\).*\(2, V, 3\)"),
        ({"vertices": (3,)}, r"vertices.*\(3,\).*\(V, 3\)"),
        ({"face_uvs": (320, 2)}, r"face_uvs.*\(320, 2\).*\(320, 3, 2\)"),
        ({"face_uvs": (7, 3, 2)}, r"face_uvs.*\(7, 3, 2\).*\(320, 3, 2\)"),
        ({"texture": (3, 24)}, r"texture.*\(3, 24\).*\(C, T, T\)"),
        ({"texture": (3, 24, 20)}, r"texture.*\(3, 24, 20\).*\(C, T, T\)"),
        ({"texture": ()}, r"texture.*\(\).*\(C, T, T\)"),
        ({"R": (2, 3)}, r"R has.*\(2, 3\).*\(B, 3, 3\)"),
        ({"t": (3,)}, r"t has.*\(3,\).*\(2, 3\)"),
        ({"K": (1, 3, 3)}, r"K has.*\(1, 3, 3\).*\(2, 3, 3\)"),
    ],
)
def test_a_shape_that_does_not_fit_is_named_with_the_one_expected(changes, said):
    scene = bumpy_sphere(views=2)
    with pytest.raises(ValueError, match=said):
        drawn(scene, **{name: torch.zeros(shape, dtype=torch.float64) for name, shape in changes.items()})


def test_faces_of_the_wrong_shape_are_named_with_the_one_expected():
    scene = bumpy_sphere(views=2)
    with pytest.raises(ValueError, match=r"faces.*\(320, 2\).*\(F, 3\)"):
        drawn(replace(scene, faces=scene.faces[:, :2]))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
def test_cuda_agrees_with_the_cpu():
    scene = bumpy_sphere((64, 64), views=3, frequency=8)
    results = []
    for device in ("cpu", "cuda"):
        arguments = scene.arguments(torch.float32, device)
        result = render(faces=scene.faces.to(device), size=scene.size, **arguments)
        loss = (result.image() - 0.3).square().mean() + (result.silhouette - 0.5).square().mean()
        loss.backward()
        results.append([result.face_index, result.silhouette, *(a.grad for a in arguments.values())])
    for index, (cpu, cuda) in enumerate(zip(*results, strict=True)):
        if index == 0:
            assert (cpu != cuda.cpu()).sum() <= 2
        else:
            error = torch.linalg.norm(cpu - cuda.cpu()) / torch.linalg.norm(cpu)
            assert error < 0.01
