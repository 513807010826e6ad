"""Gradients that lead somewhere: a perturbed pose finds back by plain Adam on what is rendered."""

from __future__ import annotations

import pytest
import torch
from scenes import rotations, waves
from torch import Tensor
from torch.nn import functional

from tracking3d.geometry.pose import Pose, rotation_angle
from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering import Rendering, SoftBand, render

SIZE = (40, 40)
STRETCHES = {"ellipsoid": [1.0, 0.75, 0.6], "disc": [1.0, 1.0, 0.3], "egg": [0.7, 1.0, 0.7]}


class Object:
    """A textured shape in front of one camera."""

    def __init__(self, shape: str) -> None:
        mesh = sphere(6)
        self.vertices = torch.tensor(mesh.vertices).float() * torch.tensor(STRETCHES[shape])
        if shape == "egg":
            self.vertices[:, 0] *= 1 + 0.4 * self.vertices[:, 1]
        self.faces, self.face_uvs = torch.tensor(mesh.faces), torch.tensor(mesh.face_uvs).float()
        self.texture = waves(48).float()
        self.K = torch.tensor([[[60.0, 0, 19.5], [0, 60.0, 19.5], [0, 0, 1]]])

    def render(self, pose: Pose, band: SoftBand) -> Rendering:
        return render(
            self.vertices,
            self.faces,
            self.face_uvs,
            self.texture,
            pose.R,
            pose.translation,
            self.K,
            SIZE,
            band,
        )


def recover(thing: Object, truth: Pose, start: Pose) -> Pose:
    """Minimize the difference of features and silhouettes, from a wide band to a narrow one."""
    translation, quaternion = (
        part.clone().requires_grad_() for part in (start.translation, start.quaternion)
    )
    optimizer = torch.optim.Adam([translation, quaternion], lr=0.02)
    for band in (SoftBand(300.0, 0.12), SoftBand(2000.0, 0.05)):
        target = thing.render(truth, band)
        for _ in range(60):
            optimizer.zero_grad()
            drawn = thing.render(Pose(translation, functional.normalize(quaternion, dim=1)), band)
            both = ((drawn.face_index >= 0) & (target.face_index >= 0))[:, None]
            appearance = ((drawn.image() - target.image()).square() * both).sum() / both.sum().clamp_min(1)
            overlap = (drawn.silhouette * target.silhouette).sum()
            union = (drawn.silhouette + target.silhouette).sum() - overlap
            (appearance + 1 - overlap / union).backward()
            optimizer.step()
        optimizer.param_groups[0]["lr"] = 0.005
    return Pose(translation, functional.normalize(quaternion, dim=1)).detach()


def pose(translation: list[float], turn: list[float]) -> Pose:
    R = rotations([turn]).float()
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    return Pose(torch.tensor([translation]), rotation_matrix_to_quaternion(R))


def degrees(a: Pose, b: Pose) -> Tensor:
    return torch.rad2deg(rotation_angle(a.quaternion, b.quaternion))[0]


@pytest.mark.parametrize("shape", STRETCHES)
def test_a_moved_object_finds_back(shape):
    thing, truth = Object(shape), pose([0.05, -0.1, 3.5], [20.0, 30.0, 10.0])
    start = Pose(truth.translation + torch.tensor([[0.12, -0.1, 0.3]]), truth.quaternion)
    found = recover(thing, truth, start)
    assert (found.translation - truth.translation)[0, :2].abs().max() < 0.01
    assert (found.translation - truth.translation)[0, 2].abs() < 0.05
    assert degrees(found, truth) < 1.5


@pytest.mark.parametrize("shape", STRETCHES)
@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, -0.5, 0.8]])
def test_an_object_turned_by_ten_degrees_finds_back(shape, axis):
    thing, truth = Object(shape), pose([0.05, -0.1, 3.5], [20.0, 30.0, 10.0])
    away = 10 * torch.tensor(axis) / torch.linalg.norm(torch.tensor(axis))
    turned = rotations([away.tolist()]).float() @ truth.R
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    found = recover(thing, truth, Pose(truth.translation, rotation_matrix_to_quaternion(turned)))
    assert degrees(found, truth) < 1.5
