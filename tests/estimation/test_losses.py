"""Every loss term of the paper against a value worked out by hand."""

from __future__ import annotations

import math

import pytest
import torch

from tracking3d.estimation.paper.problem import (
    appearance_loss,
    distance_loss,
    erode,
    iou_loss,
    laplacian_loss,
    motion_loss,
    soften,
)
from tracking3d.geometry.mesh import uniform_laplacian
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.rendering.texture_losses import cauchy


def posed(x: float = 0.0, degrees: float = 0.0, axis: tuple[float, ...] = (0.0, 0.0, 1.0)) -> Pose:
    return from_matrix(rotation_about(torch.tensor(axis), degrees), torch.tensor([x, 0.0, 3.0]))


# Two frames of 1 x 3 pixels and two channels; residuals of 1 and 2 scales cost log 2 and log 5.
OBSERVED = torch.tensor([[[[0.0, 0.0, 9.0]], [[0.0, 0.0, 9.0]]], [[[9.0, 9.0, 1.0]], [[9.0, 9.0, 1.0]]]])
RENDERED = torch.tensor([[0.5, 0.0], [1.0, -0.5], [1.0, 1.0]])
PIXELS = torch.tensor([0, 1, 5])


def pixel_losses() -> torch.Tensor:
    rows = OBSERVED.permute(0, 2, 3, 1).reshape(-1, 2)
    return cauchy(RENDERED, rows[PIXELS], 0.5).mean(1)


def appearance(valid: torch.Tensor | None = None, **options) -> list[float]:
    valid = torch.ones(2, 1, 3) if valid is None else valid
    return appearance_loss(pixel_losses(), PIXELS, valid, 0.5, **options).tolist()


def test_appearance_is_the_mean_over_channels_and_covered_pixels_of_each_frame():
    first, second = math.log(2) / 2, (math.log(5) + math.log(2)) / 2
    assert appearance() == pytest.approx([(first + second) / 2, 0.0])


def test_appearance_leaves_out_what_lies_beyond_the_border_of_the_frame():
    valid = torch.ones(2, 1, 3)
    valid[0, 0, 1] = 0
    assert appearance(valid) == pytest.approx([math.log(2) / 2, 0.0])


def test_an_object_out_of_sight_explains_nothing():
    nothing = math.log(1 + 1 / 0.5**2)  # a residual of 1
    loss = appearance_loss(pixel_losses()[:2], PIXELS[:2], torch.ones(2, 1, 3), 0.5)
    assert loss[1].item() == pytest.approx(nothing)
    outside = torch.ones(2, 1, 3)
    outside[1] = 0
    assert appearance(outside)[1] == pytest.approx(nothing)


def test_unknown_texture_costs_the_charge_in_place_of_its_residual():
    first, second = math.log(2) / 2, (math.log(5) + math.log(2)) / 2
    charged = appearance(seen=torch.tensor([0.0, 1.0, 0.25]), unseen_penalty=0.2)
    assert charged == pytest.approx([(0.2 + second) / 2, 0.75 * 0.2])
    half = appearance(seen=torch.tensor([0.5, 1.0, 1.0]), unseen_penalty=0.2)
    assert half == pytest.approx([((0.2 + first) / 2 + second) / 2, 0.0])


def test_iou_loss_is_one_minus_the_soft_intersection_over_union():
    silhouette = torch.tensor([[[1.0, 0.5], [0.0, 0.0]]])
    mask = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])
    everywhere = torch.ones(1, 2, 2)
    assert iou_loss(silhouette, mask, everywhere).item() == pytest.approx(1 - 1 / 2.5)
    upper_row = torch.tensor([[[1.0, 1.0], [0.0, 0.0]]])
    assert iou_loss(silhouette, mask, upper_row).item() == pytest.approx(1 - 1 / 1.5)
    assert iou_loss(mask, mask, everywhere).item() == pytest.approx(0, abs=1e-6)
    assert iou_loss(1 - mask, mask, everywhere).item() == pytest.approx(1)


def test_distance_loss_is_the_mean_distance_of_silhouette_pixels():
    silhouette = torch.tensor([[[1.0, 1.0], [0.5, 0.0]]])
    distance = torch.tensor([[[0.0, 0.1], [0.2, 7.0]]])
    assert distance_loss(silhouette, distance, torch.ones(1, 2, 2)).item() == pytest.approx(
        (0.1 + 0.5 * 0.2) / 2.5
    )
    upper_row = torch.tensor([[[1.0, 1.0], [0.0, 0.0]]])
    assert distance_loss(silhouette, distance, upper_row).item() == pytest.approx(0.1 / 2)
    assert distance_loss(torch.zeros(1, 2, 2), distance, torch.ones(1, 2, 2)).item() == 0


def test_erosion_takes_the_minimum_of_each_pixel_and_its_eight_neighbours():
    silhouette = torch.zeros(1, 5, 5)
    silhouette[0, 1:4, 1:4] = 1
    silhouette[0, 2, 3] = 0.4
    expected = torch.zeros(1, 5, 5)
    expected[0, 2, 2] = 0.4
    assert torch.equal(erode(silhouette), expected)


def test_erosion_does_not_eat_from_the_border_of_the_window():
    assert torch.equal(erode(torch.ones(1, 4, 4)), torch.ones(1, 4, 4))


def test_softened_target_decays_outside_the_mask_like_the_silhouette():
    pixel = 2 / 200  # in NDC; the outline is half a pixel nearer than the mask's first pixel centre
    mask, distance = torch.zeros(1, 1, 200), torch.zeros(1, 1, 200)
    mask[..., :2] = 1
    distance[..., 2:] = pixel * torch.arange(1, 199)
    target = soften(mask, distance, 7000.0)[0, 0]
    expected = [1.0, 1.0, math.exp(-7000 * (0.5 * pixel) ** 2), math.exp(-7000 * (1.5 * pixel) ** 2)]
    assert target[:4].tolist() == pytest.approx(expected, abs=1e-5)
    assert target[10:].max() < 1e-6


def test_softening_an_empty_mask_leaves_it_empty():
    assert soften(torch.zeros(1, 2, 2), torch.zeros(1, 2, 2), 7000.0).sum() == 0


def motion(current: Pose, frames: int) -> float:
    return motion_loss(posed(), current, frames, 0.1, 30.0).item()


def test_motion_beyond_a_tenth_of_a_unit_a_frame_is_charged():
    assert motion(posed(x=0.5), frames=2) == pytest.approx(0.25 - 0.1, abs=1e-6)


def test_rotation_beyond_thirty_degrees_a_frame_is_charged_in_radians():
    assert motion(posed(degrees=90), frames=2) == pytest.approx(math.radians(45 - 30), abs=1e-5)
    assert motion(posed(x=0.5, degrees=90), frames=2) == pytest.approx(0.15 + math.radians(15), abs=1e-5)


def test_slower_motion_is_free():
    assert motion(posed(x=0.19, degrees=59), frames=2) == 0


def test_motion_does_not_depend_on_the_sign_of_a_quaternion():
    turned = posed(degrees=90)
    assert motion(Pose(turned.translation, -turned.quaternion), 2) == pytest.approx(
        motion(turned, 2), abs=1e-6
    )


def test_motion_has_a_finite_gradient_where_nothing_moved():
    pose = posed()
    translation, quaternion = (
        pose.translation.clone().requires_grad_(),
        pose.quaternion.clone().requires_grad_(),
    )
    motion_loss(pose, Pose(translation, quaternion), 1, 0.1, 30.0).backward()
    assert translation.grad.isfinite().all()
    assert quaternion.grad.isfinite().all()


STRIP = torch.tensor([[0, 1, 2], [2, 1, 3]])  # 1-2 is shared; 0 and 3 have two neighbours, 1 and 2 three


def test_uniform_laplacian_subtracts_the_mean_of_the_neighbours():
    third = 1 / 3
    dense = torch.tensor(
        [[1, -0.5, -0.5, 0], [-third, 1, -third, -third], [-third, -third, 1, -third], [0, -0.5, -0.5, 1]]
    )
    torch.testing.assert_close(uniform_laplacian(STRIP, 4).to_dense(), dense)


def test_laplacian_loss_is_the_mean_squared_length_of_l_v():
    vertices = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 2.0]])
    # L v: (-1/2, -1/2, 0), (2/3, -2/3, -2/3), (-2/3, 2/3, -2/3), (1/2, 1/2, 2)
    expected = (0.5 + 12 / 9 + 12 / 9 + 4.5) / 4
    laplacian = uniform_laplacian(STRIP, 4)
    assert laplacian_loss(laplacian, vertices).item() == pytest.approx(expected, rel=1e-5)
    moved = vertices + torch.tensor([3.0, -1.0, 5.0])
    assert laplacian_loss(laplacian, moved).item() == pytest.approx(expected, rel=1e-4)


def test_laplacian_loss_pulls_towards_a_single_point():
    assert laplacian_loss(uniform_laplacian(STRIP, 4), torch.ones(4, 3)).item() == pytest.approx(0, abs=1e-12)
