"""Normal equations of poses: what autograd and stored Jacobians give, and steps that lead to the true pose."""

from __future__ import annotations

import pytest
import torch
from scenes import Textured, bumpy_sphere
from torch import Tensor

from tracking3d.geometry.pose import rotation_about
from tracking3d.rendering import Rendering, pose_normal_equations, render
from tracking3d.rendering.normal_equations import NormalEquations
from tracking3d.rendering.texture_losses import texture_losses

SCALE = 0.25


def exponential(w: Tensor) -> Tensor:
    """``(B, 3, 3)`` rotations from ``(B, 3)`` rotation vectors, differentiable at zero."""
    x, y, z = w.unbind(1)
    zero = torch.zeros_like(x)
    return torch.linalg.matrix_exp(torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3))


def moved(
    scene: Textured, step: Tensor, backend: str = "torch", dtype: torch.dtype = torch.float64
) -> Rendering:
    """The scene, rotated about the objects' origins and shifted in the camera's axes by (v, w)."""
    step = step.to(torch.float64)
    return render(
        scene.vertices.to(dtype),
        scene.faces,
        scene.face_uvs.to(dtype),
        scene.texture.to(dtype),
        (exponential(step[:, 3:]) @ scene.R).to(dtype),
        (scene.t + step[:, :3]).to(dtype),
        scene.K.to(dtype),
        scene.size,
        backend=backend,
    )


def cost(drawn: Rendering, observed: Tensor, weight: Tensor) -> Tensor:
    loss, _ = texture_losses(
        drawn.texture, drawn.uv, observed, drawn.pixels, SCALE, total_variation=False, backend=drawn.backend
    )
    batch, height, width = drawn.face_index.shape
    view = drawn.pixels // (height * width)
    total, count = (loss.new_zeros(batch).index_add(0, view, part) for part in (loss * weight, weight))
    return total / count.clamp_min(1)


def problem(channels: int = 3) -> tuple[Textured, Tensor, Tensor]:
    """A scene of two views, noisy frames, and weights with zeros among them."""
    scene = bumpy_sphere((28, 32), texture=40, channels=channels)
    generator = torch.Generator().manual_seed(5)
    still = torch.zeros(2, 6, dtype=torch.float64)
    drawn = moved(scene, still)
    observed = drawn.image() + 0.2 * torch.randn(
        drawn.image().shape, generator=generator, dtype=torch.float64
    )
    weight = torch.rand(len(drawn.pixels), generator=generator, dtype=torch.float64)
    return scene, observed, weight * (weight > 0.2)


def test_cost_and_gradient_are_those_of_autograd():
    scene, observed, weight = problem()
    step = torch.zeros(2, 6, dtype=torch.float64, requires_grad=True)
    drawn = moved(scene, step)
    expected = cost(drawn, observed, weight)
    expected.sum().backward()
    model = pose_normal_equations(drawn, observed, scene.t, SCALE, weight)
    torch.testing.assert_close(model.cost, expected.detach())
    torch.testing.assert_close(model.gradient, step.grad, rtol=1e-9, atol=1e-12)


def test_the_matrix_is_the_product_of_the_stored_jacobians():
    scene, observed, weight = problem(channels=2)
    rows = observed.permute(0, 2, 3, 1).reshape(-1, 2)

    def features(step: Tensor) -> Tensor:
        return moved(scene, step).features

    still = torch.zeros(2, 6, dtype=torch.float64)
    jacobian = torch.autograd.functional.jacobian(features, still)  # (P, C, B, 6)
    drawn = moved(scene, still)
    residual = drawn.features - rows[drawn.pixels]
    view = drawn.pixels // (28 * 32)
    model = pose_normal_equations(drawn, observed, scene.t, SCALE, weight)
    for frame in range(2):
        mine = view == frame
        J = jacobian[mine][:, :, frame]
        share = weight[mine] / weight[mine].sum() / 2
        robust = 2 / (SCALE**2 + residual[mine] ** 2) * share[:, None]
        torch.testing.assert_close(model.matrix[frame], torch.einsum("pca,pc,pcb->ab", J, robust, J))


@pytest.mark.parametrize("channels", [1, 3, 70])
def test_the_kernel_gives_the_same_equations(channels):
    scene, observed, weight = problem(channels)
    still = torch.zeros(2, 6)
    exact = pose_normal_equations(moved(scene, still), observed, scene.t, SCALE, weight)
    drawn = moved(scene, still, "numba", torch.float32)
    model = pose_normal_equations(drawn, observed.float(), scene.t.float(), SCALE, weight.float())
    for name in ("matrix", "gradient", "cost"):
        found, expected = getattr(model, name).double(), getattr(exact, name)
        assert (found - expected).norm() < 2e-4 * expected.norm(), name


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_without_weights_all_pixels_count_the_same(backend):
    scene, observed, _ = problem()
    drawn = moved(scene, torch.zeros(2, 6), backend, torch.float32)
    every = pose_normal_equations(drawn, observed.float(), scene.t.float(), SCALE)
    ones = torch.ones(len(drawn.pixels))
    same = pose_normal_equations(drawn, observed.float(), scene.t.float(), SCALE, ones)
    assert torch.equal(every.matrix, same.matrix)
    assert torch.equal(every.cost, same.cost)


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_steps_lead_to_the_true_pose_in_a_few_iterations(backend):
    scene = bumpy_sphere((64, 64), views=3, texture=64)
    truth = moved(scene, torch.zeros(3, 6))
    observed = truth.image().float()
    step = torch.tensor([[0.03, -0.02, 0.05, 0.05, -0.04, 0.03]]).repeat(3, 1)
    R, t = exponential(step[:, 3:].double()) @ scene.R, scene.t + step[:, :3]
    for _ in range(12):
        there = Textured(
            scene.vertices, scene.faces, scene.face_uvs, scene.texture, R, t, scene.K, scene.size
        )
        drawn = moved(there, torch.zeros(3, 6), backend, torch.float32)
        inside = (truth.face_index.reshape(-1)[drawn.pixels] >= 0).float()
        update = pose_normal_equations(drawn, observed, t.float(), SCALE, inside).step().double()
        R, t = exponential(update[:, 3:]) @ R, t + update[:, :3]
    turned = torch.rad2deg(
        torch.arccos(((R @ scene.R.mT).diagonal(dim1=1, dim2=2).sum(1) - 1).div(2).clamp(-1, 1))
    )
    assert turned.max() < 0.1
    assert (t - scene.t).abs().max() < 0.005


def test_a_frame_without_the_object_stands_still():
    scene, observed, _ = problem()
    away = torch.tensor([[0.0, 0, 0, 0, 0, 0], [50.0, 0, 0, 0, 0, 0]])
    for backend, dtype in (("torch", torch.float64), ("numba", torch.float32)):
        drawn = moved(scene, away, backend, dtype)
        model = pose_normal_equations(drawn, observed.to(dtype), scene.t.to(dtype), SCALE)
        step = model.step()
        assert step[0].abs().max() > 0
        assert (step[1] == 0).all() and model.cost[1] == 0


def test_models_add_up_and_damping_shortens_the_step():
    scene, observed, weight = problem()
    model = pose_normal_equations(moved(scene, torch.zeros(2, 6)), observed, scene.t, SCALE, weight)
    torch.testing.assert_close((model + model * 2).step(), model.step())
    torch.testing.assert_close((model + model * 2).cost, 3 * model.cost)
    assert (model.step(damping=10.0).norm(dim=1) < 0.2 * model.step().norm(dim=1)).all()


def test_equations_that_cannot_be_solved_give_no_step():
    broken = NormalEquations(torch.full((1, 6, 6), torch.nan), torch.ones(1, 6), torch.ones(1))
    assert (broken.step() == 0).all()


def test_rotation_vectors_of_the_tests_are_rotations():
    w = torch.tensor([[0.0, 0.0, 0.5]], dtype=torch.float64)
    about_z = rotation_about(torch.tensor([0.0, 0.0, 1.0]), 0.5 * 180 / torch.pi).double()
    torch.testing.assert_close(exponential(w)[0], about_z.reshape(3, 3), atol=1e-6, rtol=0)


def test_shapes_are_checked():
    scene, observed, _ = problem()
    drawn = moved(scene, torch.zeros(2, 6))
    with pytest.raises(ValueError, match=r"pivot has shape \(3,\), expected \(2, 3\)"):
        pose_normal_equations(drawn, observed, scene.t[0], SCALE)
