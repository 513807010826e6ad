"""Folds of a surface are smoothed away; what does not fold stays as it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tracking3d.config.models import ObjectConfig
from tracking3d.estimation.shape import RADIUS, Shape, mask_ellipse, place_on_mask, prototype_mesh, unfold
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering import project, rasterize

SPHERE = Shape.of(sphere(8), flat=False, device=torch.device("cpu"))
CAMERA = Camera(width=160, height=120, fx=150.0, fy=150.0, cx=79.5, cy=59.5)


def folded(shift: float) -> Tensor:
    """A sphere whose front is dragged sideways, far enough to lie over its neighbourhood."""
    vertices = SPHERE.rest.clone()
    near = torch.exp(-vertices[:, :2].square().sum(1) / 0.2) * (vertices[:, 2] > 0)
    vertices[:, 0] += shift * near
    return vertices


def inward_share(vertices: Tensor) -> float:
    a, b, c = vertices[SPHERE.faces].unbind(1)
    normal, centre = torch.linalg.cross(b - a, c - a), (a + b + c) / 3
    area = normal.norm(dim=1)
    middle = (centre * area[:, None]).sum(0) / area.sum()
    return float(area[((centre - middle) * normal).sum(1) < 0].sum() / area.sum())


def test_a_fold_is_smoothed_away() -> None:
    surface = folded(2.0)
    assert inward_share(surface) > 0.04
    assert inward_share(unfold(SPHERE, surface)) <= 0.01


def test_only_what_is_folded_moves() -> None:
    surface = folded(2.0)
    moved = (unfold(SPHERE, surface) - surface).norm(dim=1) > 1e-6
    assert bool(moved.any()) and not bool(moved[SPHERE.rest[:, 2] < 0].any())


def test_a_convex_surface_and_one_that_leans_stay() -> None:
    stretched = SPHERE.rest * torch.tensor([1.0, 0.4, 2.0])
    for surface in (stretched, folded(0.5)):
        assert torch.equal(unfold(SPHERE, surface), surface)


def test_a_flat_shape_has_no_folds() -> None:
    surface = folded(2.0)
    assert torch.equal(unfold(replace(SPHERE, flat=True), surface), surface)


@pytest.mark.parametrize("degrees", [-70, -20, 35, 80])
def test_a_prototype_is_placed_on_a_mask_that_has_moved_turned_and_grown(degrees: float) -> None:
    def mask(centre: tuple[float, float], axes: tuple[float, float], turned: float) -> np.ndarray:
        y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
        c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
        u, v = c * (x - centre[0]) + s * (y - centre[1]), -s * (x - centre[0]) + c * (y - centre[1])
        return np.asarray((u / axes[0]) ** 2 + (v / axes[1]) ** 2 < 1)

    first, later = mask((60, 50), (24, 12), 10), mask((95, 66), (32, 16), 10 + degrees)
    mesh = prototype_mesh(ObjectConfig(prototype="ellipsoid"), mask_ellipse(first))
    rest = torch.from_numpy(mesh.vertices).float()
    pose = place_on_mask(rest, CAMERA, later)
    assert float(rest.norm(dim=1).max()) == pytest.approx(RADIUS, rel=0.01)
    K = torch.tensor(CAMERA.K, dtype=torch.float32)[None]
    screen, depth = project(rest, pose.R[None], pose.translation[None], K)
    faces = torch.from_numpy(mesh.faces)
    drawn = rasterize(screen, depth, faces, later.shape, "auto").face_index[0].numpy() >= 0
    assert (drawn & later).sum() / (drawn | later).sum() > 0.9


def test_the_direction_of_what_is_round_is_not_taken_for_a_turn() -> None:
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    pose = place_on_mask(SPHERE.rest, CAMERA, np.hypot(x - 70, 1.04 * (y - 60)) < 25)
    assert torch.equal(pose.R, torch.eye(3))
