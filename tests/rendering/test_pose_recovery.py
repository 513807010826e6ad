"""Gradients that lead somewhere: a perturbed pose finds back by plain Adam on what is rendered."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from scenes import rotations, waves
from torch import Tensor
from torch.nn import functional

from tracking3d.geometry.pose import Pose, rotation_angle
from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering import Rendering, SoftBand, render

SIZE = (40, 40)
TRUTH = ([0.05, -0.1, 3.5], [20.0, 30.0, 10.0])
AXES = {"tilted": [1.0, 0.0, 0.0], "panned": [0.0, 1.0, 0.0], "rolled askew": [0.3, -0.5, 0.8]}
STAGES = [
    (SoftBand(300.0, 0.12), 0.02),
    (SoftBand(300.0, 0.12), 0.01),
    (SoftBand(2000.0, 0.05), 0.005),
    (SoftBand(2000.0, 0.05), 0.001),
]
"""Kernels of the silhouette with Adam's rate."""


def box(unit: Tensor) -> Tensor:
    """A box with rounded edges: a ball of the norm of order 6."""
    return unit / unit.abs().pow(6).sum(1, keepdim=True).pow(1 / 6) * torch.tensor([0.8, 0.6, 0.5])


def dented(unit: Tensor) -> Tensor:
    """A ball with bumps all over and a dent in one side."""
    x, y, z = unit.unbind(1)
    radius = 1 + 0.12 * torch.sin(4 * x + 1) * torch.cos(5 * y) - 0.35 * torch.exp(-3 * (1 - z))
    return unit * (0.85 * radius)[:, None]


def egg(unit: Tensor) -> Tensor:
    sides = 1 + 0.4 * unit[:, 1]
    return torch.stack([0.7 * sides * unit[:, 0], unit[:, 1], 0.7 * unit[:, 2]], 1)


SHAPES: dict[str, Callable[[Tensor], Tensor]] = {
    "ellipsoid": lambda unit: unit * torch.tensor([1.0, 0.75, 0.6]),
    "disc": lambda unit: unit * torch.tensor([1.0, 1.0, 0.3]),
    "egg": egg,
    "box": box,
    "dented": dented,
}


class Object:
    """A textured shape in front of one camera."""

    def __init__(self, shape: str, backend: str = "auto") -> None:
        mesh = sphere(6)
        self.vertices = SHAPES[shape](torch.tensor(mesh.vertices).float())
        self.faces, self.face_uvs = torch.tensor(mesh.faces), torch.tensor(mesh.face_uvs).float()
        self.texture = waves(48).float()
        self.K = torch.tensor([[[60.0, 0, 19.5], [0, 60.0, 19.5], [0, 0, 1]]])
        self.backend = backend

    def render(self, pose: Pose, band: SoftBand) -> Rendering:
        return render(
            self.vertices,
            self.faces,
            self.face_uvs,
            self.texture,
            pose.R,
            pose.translation,
            self.K.expand(len(pose.R), 3, 3),
            SIZE,
            band,
            self.backend,
        )


def recover(thing: Object, truth: Pose, start: Pose) -> Pose:
    """Minimize the difference of features and silhouettes, from a wide band to a narrow one, in ever smaller steps.

    Several starts do not know of each other: their losses are added, and Adam treats every number by itself.
    """
    translation, quaternion = (
        part.clone().requires_grad_() for part in (start.translation, start.quaternion)
    )
    optimizer = torch.optim.Adam([translation, quaternion])
    for band, rate in STAGES:
        target = thing.render(truth, band)
        hard, image = target.face_index >= 0, target.image()
        optimizer.param_groups[0]["lr"] = rate
        for _ in range(40):
            optimizer.zero_grad()
            drawn = thing.render(Pose(translation, functional.normalize(quaternion, dim=1)), band)
            both = ((drawn.face_index >= 0) & hard)[:, None]
            unlike = ((drawn.image() - image).square() * both).sum((1, 2, 3))
            appearance = unlike / both.sum((1, 2, 3)).clamp_min(1)
            # Unlike the overlap of two soft masks, this is least where both are the same.
            outline = (drawn.silhouette - target.silhouette).square().sum((1, 2)) / target.silhouette.sum()
            (appearance + outline).sum().backward()
            optimizer.step()
    return Pose(translation, functional.normalize(quaternion, dim=1)).detach()


def pose(translation: list[float], turn: list[float]) -> Pose:
    return Pose(torch.tensor([translation]), rotation_matrix_to_quaternion(rotations([turn]).float()))


def turned(truth: Pose, degrees: float, axis: str) -> Pose:
    away = degrees * functional.normalize(torch.tensor(AXES[axis]), dim=0)
    R = rotations([away.tolist()]).float() @ truth.R
    return Pose(truth.translation, rotation_matrix_to_quaternion(R))


def degrees(a: Pose, b: Pose) -> Tensor:
    return torch.rad2deg(rotation_angle(a.quaternion, b.quaternion))[0]


@pytest.fixture
def truth() -> Pose:
    return pose(*TRUTH)


def assert_found(found: Pose, truth: Pose) -> None:
    assert degrees(found, truth) < 0.1
    assert (found.translation - truth.translation).abs().max() < 0.001


Start = tuple[float, str, tuple[float, float, float]]
"""By how many degrees around which axis, and how far, an object is away from the truth."""
STILL, AWAY, NEARER = (0.0, 0.0, 0.0), (0.12, -0.1, 0.3), (-0.1, 0.1, -0.2)
ANGLES = (10.0, 20.0)
STARTS: dict[str, list[Start]] = {
    "auto": [
        (0.0, "tilted", AWAY),
        *[(angle, axis, STILL) for angle in ANGLES for axis in AXES],
        *[(-15.0, axis, NEARER) for axis in AXES],
    ],
    "torch": [(angle, "rolled askew", AWAY) for angle in ANGLES],
}


@cache
def recovered(shape: str, backend: str = "auto") -> dict[Start, Pose]:
    """What is found from every start; all of a shape at once, which takes hardly longer than one."""
    truth, starts = pose(*TRUTH), STARTS[backend]
    away = [turned(truth, angle, axis) for angle, axis, _ in starts]
    shift = torch.tensor([shift for _, _, shift in starts])
    start = Pose(truth.translation + shift, torch.cat([pose.quaternion for pose in away]))
    found = recover(Object(shape, backend), truth, start)
    parts = zip(found.translation.split(1), found.quaternion.split(1), strict=True)
    return {start: Pose(*part) for start, part in zip(starts, parts, strict=True)}


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_a_moved_object_finds_back(shape, truth):
    assert_found(recovered(shape)[0.0, "tilted", AWAY], truth)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("angle", ANGLES, ids="by {:g} degrees".format)
def test_a_turned_object_finds_back(angle, shape, axis, truth):
    assert_found(recovered(shape)[angle, axis, STILL], truth)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("shape", SHAPES)
def test_an_object_that_is_turned_and_moved_finds_back(shape, axis, truth):
    assert_found(recovered(shape)[-15.0, axis, NEARER], truth)


@pytest.mark.parametrize("shape", ["box", "dented"])
@pytest.mark.parametrize("angle", ANGLES, ids="by {:g} degrees".format)
def test_a_turned_object_finds_back_with_torch_as_well(angle, shape, truth):
    assert_found(recovered(shape, "torch")[angle, "rolled askew", AWAY], truth)


@pytest.mark.slow
@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("shape", SHAPES)
def test_every_turned_object_finds_back_with_torch_as_well(shape, axis, truth):
    assert_found(recover(Object(shape, "torch"), truth, turned(truth, 20.0, axis)), truth)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(8))
def test_any_object_finds_back_from_any_pose(seed, shape):
    generator = torch.Generator().manual_seed(seed)
    truth = pose(TRUTH[0], (180 * (2 * torch.rand(3, generator=generator) - 1)).tolist())
    away = functional.normalize(torch.randn(3, generator=generator), dim=0)
    R = rotations([(20 * away).tolist()]).float() @ truth.R
    shift = 0.1 * torch.randn(1, 3, generator=generator)
    start = Pose(truth.translation + shift, rotation_matrix_to_quaternion(R))
    assert_found(recover(Object(shape), truth, start), truth)
