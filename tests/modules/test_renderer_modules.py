"""Renderer, silhouette and losses as modules: what the functions give, with kornia's cameras and poses."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from kornia.geometry.quaternion import Quaternion
from torch.autograd import gradcheck

from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.modules import (
    LaplacianLoss,
    MeshRenderer,
    OutlineLoss,
    Silhouette,
    SilhouetteLoss,
    TexturedMesh,
    TextureLoss,
    pinhole_of_camera,
    pose_from_se3,
)
from tracking3d.rendering import SoftBand, render

CAMERA = Camera(30.0, 31.0, 11.7, 9.2, 24, 20)
BAND = SoftBand(sigma=300.0, boxlen=0.1)
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "fit_textured_mesh.py"


def textured(dtype: torch.dtype = torch.float64) -> TexturedMesh:
    generator = torch.Generator().manual_seed(0)
    mesh = TexturedMesh.of(sphere(2), torch.rand(3, 8, 8, generator=generator, dtype=dtype))
    with torch.no_grad():
        mesh.vertices *= torch.tensor([1.0, 0.8, 0.7], dtype=dtype)
    return mesh


def quaternions(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.tensor([[2.0, 0.3, -0.4, 0.2], [1.0, -0.6, 0.1, 0.5]], dtype=dtype)  # of any length


def translations(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.tensor([[0.1, -0.05, 3.6], [-0.2, 0.1, 4.0]], dtype=dtype)


def poses(dtype: torch.dtype = torch.float64) -> Se3:
    return Se3(Quaternion(quaternions(dtype)), translations(dtype))


@pytest.fixture
def cameras() -> PinholeCamera:
    return pinhole_of_camera(CAMERA, 2, torch.float64)


def test_the_module_draws_what_the_function_draws(cameras):
    mesh, pose = textured(), pose_from_se3(poses())
    views = MeshRenderer(BAND)(mesh, cameras, poses())
    K = torch.tensor(CAMERA.K).expand(2, 3, 3)
    drawn = render(
        mesh.vertices, mesh.faces, mesh.face_uvs, mesh.texture, pose.R, pose.translation, K, (20, 24), BAND
    )
    assert views.image.shape == (2, 3, 20, 24)
    assert views.silhouette.shape == views.depth.shape == (2, 1, 20, 24)
    torch.testing.assert_close(views.image, drawn.image())
    torch.testing.assert_close(views.silhouette[:, 0], drawn.silhouette)
    torch.testing.assert_close(views.depth, drawn.image(drawn.points[:, 2:]))
    alone = Silhouette(BAND)(mesh.vertices, mesh.faces, cameras, poses())
    torch.testing.assert_close(alone, views.silhouette)


def test_one_camera_or_one_pose_serves_all_frames(cameras):
    mesh, renderer = textured(), MeshRenderer()
    both = renderer(mesh, cameras, poses()).image
    torch.testing.assert_close(
        renderer(mesh, pinhole_of_camera(CAMERA, 1, torch.float64), poses()).image, both
    )
    single = Se3(Quaternion(quaternions()[0]), translations()[0])
    torch.testing.assert_close(renderer(mesh, cameras, single).image, both[:1].expand(2, -1, -1, -1))


def test_extrinsics_follow_the_pose(cameras):
    half = Se3(
        Quaternion(torch.tensor([[1.0, 0.2, 0, 0]] * 2).double()), torch.tensor([[0.1, 0, 1.0]] * 2).double()
    )
    moved = PinholeCamera(cameras.intrinsics, half.matrix().detach(), cameras.height, cameras.width)
    mesh, renderer = textured(), MeshRenderer()
    torch.testing.assert_close(
        renderer(mesh, moved, poses()).image, renderer(mesh, cameras, half * poses()).image
    )


def test_float64_gradients_are_right_through_everything(cameras):
    """Vertices, texture, quaternions of any length, translations and intrinsics, through losses that are exact.

    The outline's holds the weights of its points fixed.
    """
    mesh = textured()
    target = MeshRenderer(BAND)(mesh, cameras, poses())
    image = target.image.detach()
    mask = (target.drawn.face_index >= 0).double()[:, None].roll(1, 3)
    smooth = LaplacianLoss(mesh.faces, len(mesh.vertices))

    def losses(vertices, texture, quaternion, translation, lens):
        zero, one = torch.zeros_like(lens[:, 0]), torch.ones_like(lens[:, 0])
        fx, fy, cx, cy = lens.unbind(1)
        rows = (fx, zero, cx, zero), (zero, fy, cy, zero), (zero, zero, one, zero), (zero, zero, zero, one)
        intrinsics = torch.stack([torch.stack(row, 1) for row in rows], 1)
        moving = TexturedMesh(vertices, mesh.faces, mesh.face_uvs, texture)
        moving.forward = lambda: (vertices, texture)  # as they are, no leaves of their own
        camera = PinholeCamera(intrinsics, cameras.extrinsics, cameras.height, cameras.width)
        views = MeshRenderer(BAND)(moving, camera, Se3(Quaternion(quaternion), translation))
        drawn = views.drawn
        # Image differences in the interior alone: visibility is held fixed.
        inside = drawn.image(torch.ones_like(drawn.uv[:, :1]))
        return (
            SilhouetteLoss("none")(views.silhouette, mask),
            TextureLoss(roughness=0.1)(views, image),
            (inside * (views.image - image)).square().mean(),
            smooth(vertices),
        )

    arguments = (
        mesh.vertices.detach(),
        mesh.texture.detach(),
        quaternions(),
        translations() + 0.03,
        torch.tensor([[30.0, 31.0, 11.7, 9.2]] * 2, dtype=torch.float64),
    )
    leaves = [one.clone().requires_grad_() for one in arguments]
    for number in range(4):
        needed = leaves if number < 3 else leaves[:1]

        def one(*changed, number=number):
            return losses(*changed, *leaves[len(changed) :])[number]

        assert gradcheck(one, needed, eps=1e-7, atol=1e-4, rtol=1e-3, fast_mode=True), number


def test_a_mesh_is_saved_and_its_parameters_are_learnt(tmp_path):
    mesh = textured(torch.float32)
    assert [name for name, _ in mesh.named_parameters()] == ["vertices", "texture"]
    torch.save(mesh.state_dict(), tmp_path / "mesh.pt")
    other = textured(torch.float32)
    with torch.no_grad():
        other.vertices.zero_()
    other.load_state_dict(torch.load(tmp_path / "mesh.pt", weights_only=True))
    torch.testing.assert_close(other.vertices, mesh.vertices)


def test_losses_are_small_where_all_is_right_and_larger_where_it_is_not(cameras):
    mesh, renderer = textured(), MeshRenderer()
    views = renderer(mesh, cameras, poses())
    mask = (views.drawn.face_index >= 0).double()[:, None]
    away = Se3(Quaternion(quaternions()), translations() + torch.tensor([0.3, 0, 0], dtype=torch.float64))
    moved = renderer(mesh, cameras, away)
    assert SilhouetteLoss()(views.silhouette, mask) < 0.15 < SilhouetteLoss()(moved.silhouette, mask)
    assert OutlineLoss()(views, mask) < OutlineLoss()(moved, mask)
    image = views.image.detach()
    assert TextureLoss()(views, image) < 1e-12 < TextureLoss()(moved, image)
    assert SilhouetteLoss("none")(views.silhouette, mask).shape == (2,)
    nothing = torch.zeros_like(mask)
    assert float(SilhouetteLoss()(moved.silhouette.detach(), mask, nothing)) == pytest.approx(1.0)


def test_what_does_not_fit_together_is_told(cameras):
    mesh, renderer = textured(), MeshRenderer()
    three = Se3(Quaternion(torch.ones(3, 4).double()), torch.ones(3, 3).double())
    with pytest.raises(ValueError, match="camera has 2 frames and pose 3"):
        renderer(mesh, cameras, three)
    skewed = cameras.intrinsics.clone()
    skewed[0, 0, 1] = 1
    with pytest.raises(ValueError, match="camera has a skew"):
        renderer(mesh, PinholeCamera(skewed, cameras.extrinsics, cameras.height, cameras.width), poses())
    uneven = PinholeCamera(cameras.intrinsics, cameras.extrinsics, torch.tensor([20, 30]), cameras.width)
    with pytest.raises(ValueError, match=r"frames of the sizes \[\(20, 24\), \(30, 24\)\]"):
        renderer(mesh, uneven, poses())
    with pytest.raises(ValueError, match="reduction is 'sum'"):
        SilhouetteLoss("sum")
    with pytest.raises(ValueError, match=r"mask has shape \(2, 20, 24\)"):
        SilhouetteLoss()(torch.zeros(2, 1, 20, 24), torch.zeros(2, 20, 24))


def test_the_example_fits_a_mesh_to_images(capsys):
    losses = runpy.run_path(str(EXAMPLE))["main"](6)
    assert losses[-1] < 0.9 * losses[0]
    assert capsys.readouterr().out.startswith("loss 0.")
