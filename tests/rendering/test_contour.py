"""The contour term: points on the outline, zero on the true mask, a pull from far away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import Textured, bumpy_sphere
from test_normal_equations import exponential, moved
from torch import Tensor
from torch.autograd import gradcheck

from tracking3d.rendering import Rendering, SoftBand, render
from tracking3d.rendering.contour import (
    contour_distance,
    contour_loss,
    contour_normal_equations,
    contour_slopes,
    find_contour,
    signed_distance,
)

STILL = torch.zeros(2, 6, dtype=torch.float64)


def covered(drawn: Rendering) -> Tensor:
    return (drawn.face_index >= 0).double()


def test_signed_distance_is_half_a_pixel_on_both_sides_of_the_outline_and_negative_inside():
    mask = torch.zeros(1, 5, 7, dtype=torch.float64)
    mask[0, 1:4, 1:5] = 1
    distance = signed_distance(mask)[0]
    assert distance[2].tolist() == [0.5, -0.5, -1.5, -1.5, -0.5, 0.5, 1.5]
    assert distance[0, 0] == pytest.approx(np.sqrt(2) - 0.5)


@pytest.mark.parametrize("fill", [0.0, 1.0])
def test_a_mask_without_an_outline_pulls_nowhere(fill):
    assert (signed_distance(torch.full((2, 4, 4), fill)) == 0).all()


def test_the_contour_of_a_ball_is_its_circle():
    """A ball of radius r at distance d is seen as a circle of radius f r / sqrt(d^2 - r^2)."""
    scene = bumpy_sphere((80, 80), views=1, frequency=24)
    ball = scene.vertices / scene.vertices.norm(dim=1, keepdim=True)
    K = torch.tensor([[[100.0, 0, 39.5], [0, 100.0, 39.5], [0, 0, 1]]], dtype=torch.float64)
    t = torch.tensor([[0.0, 0.0, 3.5]], dtype=torch.float64)
    drawn = moved(
        replace(scene, vertices=ball, K=K, t=t, R=torch.eye(3, dtype=torch.float64)[None]), STILL[:1]
    )
    contour = find_contour(drawn)
    radius = 100 / np.sqrt(3.5**2 - 1)
    away = contour.position - 39.5
    torch.testing.assert_close(away.norm(dim=1), torch.full_like(away[:, 0], radius), atol=0.3, rtol=0)
    assert contour.length.sum().item() == pytest.approx(2 * np.pi * radius, rel=0.02)
    assert ((contour.normal * away).sum(1) / away.norm(dim=1)).min() > 0.95  # outward


def test_contour_points_lie_on_the_outline_of_what_is_drawn():
    drawn = moved(bumpy_sphere((60, 70), frequency=8), STILL)
    contour = find_contour(drawn)
    distance = contour_distance(contour, signed_distance(covered(drawn)))
    assert distance.abs().max() < 1.5
    assert abs(distance.mean()) < 0.1
    outline = (covered(drawn)[:, 1:] != covered(drawn)[:, :-1]).sum()
    assert contour.length.sum() > 0.6 * outline


def test_surface_points_of_the_contour_project_to_their_positions():
    scene = bumpy_sphere((40, 50))
    drawn = moved(scene, STILL)
    contour = find_contour(drawn)
    pixel = (drawn.K[contour.view] @ contour.points[..., None])[..., 0]
    torch.testing.assert_close(pixel[:, :2] / pixel[:, 2:], contour.position)


def test_surface_points_of_the_contour_are_mixed_from_the_ends_of_their_edges():
    drawn = moved(bumpy_sphere((40, 50)), STILL)
    contour = find_contour(drawn)
    ends = drawn.x_cam[contour.view[:, None], contour.vertices]
    torch.testing.assert_close((contour.share[..., None] * ends).sum(1), contour.points)
    torch.testing.assert_close(contour.share.sum(1), torch.ones_like(contour.share[:, 0]))
    assert contour.share.min() > 0


def test_the_ends_of_a_contour_edge_are_joined_in_the_mesh():
    drawn = moved(bumpy_sphere((40, 50)), STILL)
    edges = torch.cat([drawn.faces[:, [0, 1]], drawn.faces[:, [1, 2]], drawn.faces[:, [2, 0]]])
    known = {tuple(edge) for edge in edges.tolist()}
    assert {tuple(edge) for edge in find_contour(drawn).vertices.tolist()} <= known


def test_the_middle_of_an_edge_on_the_screen_is_nearer_in_space_to_the_end_that_is_nearer_to_the_camera():
    """Half-way on the screen between depths 1 and 3 is a quarter of the way in space, at depth 3 / 2."""
    K = torch.eye(3, dtype=torch.float64)[None]
    vertices = torch.tensor([[0.0, 0, 1], [3.0, 0, 3], [0.0, 3, 3]], dtype=torch.float64)
    uvs, texture = torch.zeros(1, 3, 2, dtype=torch.float64), torch.zeros(1, 4, 4, dtype=torch.float64)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    drawn = render(vertices, torch.tensor([[0, 2, 1]]), uvs, texture, K.clone(), zero, K, (3, 3))
    contour = find_contour(drawn)
    middle = (contour.vertices.sort(1).values == torch.tensor([0, 1])).all(1)
    assert contour.points[middle].tolist() == [[0.75, 0.0, 1.5]]
    assert sorted(contour.share[middle][0].tolist()) == [0.25, 0.75]


def two_squares() -> tuple[Tensor, Tensor]:
    """A small square before a large one, both facing the camera at z = 4 and z = 5."""
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64)
    vertices = torch.cat([2 * corners + torch.tensor([0, 0, 5.0]), 0.5 * corners + torch.tensor([0, 0, 4.0])])
    faces = torch.tensor([[0, 2, 1], [0, 3, 2]])
    return vertices, torch.cat([faces, faces + 4])


def drawn_squares(size: int = 60) -> Rendering:
    vertices, faces = two_squares()
    K = torch.tensor([[[50.0, 0, 29.5], [0, 50.0, 29.5], [0, 0, 1]]], dtype=torch.float64)
    uvs, texture = torch.rand(4, 3, 2, dtype=torch.float64), torch.rand(1, 4, 4, dtype=torch.float64)
    eye, zero = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    return render(vertices, faces, uvs, texture, eye, zero, K, (size, size))


def test_an_open_mesh_ends_at_its_rim_and_inner_contours_do_not_count():
    drawn = drawn_squares()
    assert (drawn.face_index >= 2).any() and (drawn.face_index < 2).any()
    contour = find_contour(drawn)
    away = (contour.position - 29.5).abs().amax(1)
    torch.testing.assert_close(away, torch.full_like(away, 20.0))
    assert contour.length.sum().item() == pytest.approx(160)


def test_what_lies_outside_the_window_is_left_out():
    drawn = drawn_squares(40)  # the window ends at pixel 39.5, the square reaches from 9.5 to 49.5
    contour = find_contour(drawn)
    assert contour.position.max() < 39.5
    assert contour.length.sum().item() == pytest.approx(60, abs=2)


def test_gradients_by_vertices_pose_and_camera_are_those_of_finite_differences():
    scene = bumpy_sphere((24, 26), frequency=2)
    shifted = moved(scene, torch.tensor([[0.1, 0.05, 0, 0, 0, 0]]).repeat(2, 1))
    distance = signed_distance(covered(shifted))
    arguments = scene.arguments()
    length = find_contour(moved(scene, STILL)).length  # held fixed, as visibility is

    def loss(*values: Tensor) -> Tensor:
        named = dict(zip(arguments, values, strict=True))
        contour = find_contour(render(faces=scene.faces, size=scene.size, **named))
        return contour_loss(replace(contour, length=length), distance, 2.0)

    for name in ("vertices", "R", "t", "K"):
        free = [value if key == name else value.detach() for key, value in arguments.items()]
        assert gradcheck(loss, tuple(free), eps=1e-7, atol=1e-4, rtol=1e-3), name


def test_slopes_are_finite_differences_of_the_distance():
    scene = bumpy_sphere((30, 34))
    contour = find_contour(moved(scene, STILL))
    generator = torch.Generator().manual_seed(0)
    distance = 5 * torch.randn(2, 30, 34, dtype=torch.float64, generator=generator)
    value, slope = contour_slopes(contour, distance)
    torch.testing.assert_close(value, contour_distance(contour, distance).detach())
    for axis in (0, 1):
        step = torch.zeros(2, dtype=torch.float64)
        step[axis] = 1e-6
        ahead, behind = (
            contour_distance(replace(contour, position=contour.position + way * step), distance)
            for way in (1, -1)
        )
        torch.testing.assert_close(slope[:, axis], (ahead - behind) / 2e-6, atol=1e-5, rtol=0)


def test_slopes_of_a_distance_that_rises_to_the_right_point_there():
    contour = find_contour(moved(bumpy_sphere((20, 24)), STILL))
    ramp = torch.arange(24, dtype=torch.float64).expand(2, 20, 24)
    value, slope = contour_slopes(contour, ramp)
    torch.testing.assert_close(value, contour.position[:, 0])
    assert (slope == torch.tensor([1.0, 0.0])).all()


def test_normal_equations_have_the_gradient_of_the_loss():
    scene = bumpy_sphere((48, 50), frequency=10)
    distance = signed_distance(covered(moved(scene, torch.tensor([[0.1, 0.05, 0, 0, 0, 0.1]]).repeat(2, 1))))
    step = STILL.clone().requires_grad_()
    drawn = moved(scene, step)
    contour = find_contour(drawn)
    loss = contour_loss(contour, distance, 2.0)
    loss.sum().backward()
    model = contour_normal_equations(drawn, contour, distance, scene.t, 2.0)
    torch.testing.assert_close(model.cost, loss.detach())
    # A contour point slides along its edge, which a surface point does not: the same but for that.
    error = (model.gradient - step.grad).norm(dim=1) / step.grad.norm(dim=1)
    assert error.max() < 0.02
    torch.testing.assert_close(model.matrix, model.matrix.mT)


def test_gauss_newton_on_the_contour_finds_a_shift_of_ten_pixels():
    scene = bumpy_sphere((90, 90), views=1, frequency=8)
    truth = moved(scene, STILL[:1])
    distance = signed_distance(covered(truth))
    t, R = scene.t + torch.tensor([0.3, -0.25, 0.0]), scene.R
    band = SoftBand()
    for _ in range(20):
        drawn = render(
            scene.vertices, scene.faces, scene.face_uvs, scene.texture, R, t, scene.K, scene.size, band
        )
        model = contour_normal_equations(drawn, find_contour(drawn), distance, t, 3.0)
        update = model.step(damping=1e-2)
        t, R = t + update[:, :3], exponential(update[:, 3:]) @ R
    here = moved(replace(scene, R=R, t=t), STILL[:1])
    overlap = (covered(here) * covered(truth)).sum() / (covered(here) + covered(truth)).clamp_max(1).sum()
    assert overlap > 0.985


def test_a_frame_without_the_object_has_no_contour_and_no_pull():
    scene: Textured = bumpy_sphere()
    drawn = moved(scene, torch.tensor([[0.0, 0, 0, 0, 0, 0], [50.0, 0, 0, 0, 0, 0]]))
    contour = find_contour(drawn)
    assert set(contour.view.tolist()) == {0}
    loss = contour_loss(contour, signed_distance(covered(drawn)), 2.0)
    assert loss[1] == 0
    assert (
        contour_normal_equations(drawn, contour, signed_distance(covered(drawn)), scene.t, 2.0).step()[1] == 0
    ).all()
