"""The terms of a pose's cost: what finite differences say in float64, and the kernel the same as torch."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from implementations import NUMBA, TORCH32, TORCH64, Implementation
from scenes import Textured, bumpy_sphere
from test_normal_equations import exponential
from torch import Tensor

from tracking3d.rendering import (
    MatchedPoints,
    PoseTarget,
    PoseTerms,
    Scales,
    Surface,
    pose_terms,
    render,
    signed_distance,
)

SIZE = 40
SCALES = Scales(appearance=0.25, outline=2.0, points=1.5)
NAMES = ("appearance", "outline", "points")


def scene_of(channels: int = 3) -> Textured:
    return bumpy_sphere((SIZE, SIZE), texture=48, channels=channels)


def problem(
    by: Implementation, channels: int = 3, masked: bool = True
) -> tuple[Surface, PoseTarget, MatchedPoints]:
    """A bumpy sphere of which a half was seen, a frame with noise and part of it beyond the border, 12 points."""
    scene = scene_of(channels)
    random = torch.Generator().manual_seed(3)
    seen = torch.zeros(1, 48, 48, dtype=torch.float64)
    seen[..., :30] = 1
    surface = Surface(scene.vertices, scene.faces, scene.face_uvs, scene.texture, seen)
    drawn = render(
        scene.vertices, scene.faces, scene.face_uvs, scene.texture, scene.R, scene.t, scene.K, scene.size
    )
    image = drawn.image()[0]
    features = image + 0.1 * torch.randn(image.shape, generator=random, dtype=torch.float64)
    mask = (drawn.face_index[0] >= 0).roll((2, 1), (0, 1))
    inside = torch.ones(SIZE, SIZE, dtype=torch.bool)
    inside[:, -9:] = False
    weight = torch.rand(SIZE, SIZE, generator=random, dtype=torch.float64) * inside
    distance = signed_distance(mask[None].double())[0]
    target = PoseTarget(scene.K[0], features, weight, inside, mask, distance)
    if not masked:
        target = replace(target, mask=None, distance=None)
    points = scene.vertices[::17][:12]
    x_cam = points @ scene.R[0].T + scene.t[0]
    pixels = (x_cam / x_cam[:, 2:] @ scene.K[0].T)[:, :2]
    pixels = pixels + 2 * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
    return (
        in_numbers(surface, by, renderer=by.backend),
        in_numbers(target, by),
        in_numbers(MatchedPoints(points, pixels), by),
    )


def in_numbers(data, by: Implementation, **others):
    """A dataclass with its floating-point tensors in an implementation's numbers."""
    cast = {
        name: value.to(by.dtype)
        for name, value in vars(data).items()
        if isinstance(value, Tensor) and value.is_floating_point()
    }
    return replace(data, **cast, **others)


def poses(by: Implementation, steps: Tensor) -> tuple[Tensor, Tensor]:
    """The scene's first pose after steps ``(B, 6)``."""
    scene = scene_of()
    return (exponential(steps[:, 3:]) @ scene.R[0]).to(by.dtype), (scene.t[0] + steps[:, :3]).to(by.dtype)


def terms_at(by: Implementation, steps: Tensor, channels: int = 3, masked: bool = True) -> PoseTerms:
    surface, target, matched = problem(by, channels, masked)
    return pose_terms(surface, target, *poses(by, steps), matched, SCALES)


def some_steps() -> Tensor:
    random = torch.Generator().manual_seed(11)
    steps = 0.05 * torch.randn(5, 6, generator=random, dtype=torch.float64)
    steps[0] = 0
    return steps


@pytest.mark.parametrize("masked", [True, False], ids=["mask", "no mask"])
@pytest.mark.parametrize("channels", [1, 3, 16])
def test_the_kernel_says_what_torch_says(channels, masked):
    steps = some_steps()
    by_torch = terms_at(TORCH32, steps, channels, masked)
    by_kernel = terms_at(NUMBA, steps, channels, masked)
    for name in NAMES:
        expected, found = getattr(by_torch, name), getattr(by_kernel, name)
        torch.testing.assert_close(found.cost, expected.cost, rtol=2e-4, atol=1e-6)
        for part in ("matrix", "gradient"):
            size = float(getattr(expected, part).abs().max()) or 1.0
            error = (getattr(found, part) - getattr(expected, part)).abs().max()
            assert float(error) < 1e-3 * size, (name, part)
    for name in ("comparable", "known", "overlap"):
        torch.testing.assert_close(
            getattr(by_kernel, name), getattr(by_torch, name), rtol=1e-4, atol=1e-4, msg=name
        )
    assert (by_kernel.overlap == 1).all() == (not masked)


@pytest.mark.parametrize("by", [TORCH32, NUMBA], ids=str)
def test_float32_says_what_float64_says(by):
    steps = some_steps()
    exact, found = terms_at(TORCH64, steps), terms_at(by, steps)
    for name in NAMES:
        a, b = getattr(exact, name), getattr(found, name)
        torch.testing.assert_close(b.cost, a.cost, rtol=1e-2, atol=1e-4)
        assert float((a.gradient - b.gradient).abs().max()) < 0.02 * float(a.gradient.abs().max())


def test_gradients_are_those_of_finite_differences():
    """Of points and outline; of pixels `pose_normal_equations` is tested against autograd."""
    h = 1e-6
    here = terms_at(TORCH64, torch.zeros(1, 6, dtype=torch.float64))
    there = terms_at(TORCH64, torch.cat([h * torch.eye(6), -h * torch.eye(6)]).double())
    for name, tolerance in (("points", 1e-6), ("outline", 5e-3)):
        cost = getattr(there, name).cost
        by_differences = (cost[:6] - cost[6:]) / (2 * h)
        gradient = getattr(here, name).gradient[0]
        assert float((gradient - by_differences).abs().max()) < tolerance * float(gradient.abs().max()), name


def test_the_points_matrix_is_the_product_of_their_jacobians():
    _, target, matched = problem(TORCH64)
    h = 1e-5

    def residuals(steps: Tensor) -> Tensor:
        R, t = poses(TORCH64, steps)
        x_cam = matched.points @ R.mT + t[:, None]
        return (x_cam / x_cam[..., 2:] @ target.K.T)[..., :2] - matched.pixels

    there = residuals(torch.cat([h * torch.eye(6), -h * torch.eye(6)]).double())
    jacobian = (there[:6] - there[6:]) / (2 * h)  # (6, N, 2)
    here = residuals(torch.zeros(1, 6, dtype=torch.float64))[0]
    weight = 2 / (SCALES.points**2 + here.square().sum(1)) / len(here)
    expected = torch.einsum("ani,n,bni->ab", jacobian, weight, jacobian)
    found = terms_at(TORCH64, torch.zeros(1, 6, dtype=torch.float64)).points.matrix[0]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("by", [TORCH64, TORCH32, NUMBA], ids=str)
def test_an_object_beside_the_window_or_at_no_place_says_nothing(by):
    steps = torch.zeros(2, 6, dtype=torch.float64)
    steps[0, 0] = 50.0
    steps[1, 2] = -50.0  # behind the camera
    terms = terms_at(by, steps)
    assert not terms.comparable.any() and not terms.known.any() and not terms.overlap.any()
    for name in ("appearance", "outline"):
        model = getattr(terms, name)
        assert not (model.cost.any() or model.gradient.any() or model.matrix.any())
    assert terms.points.cost.isfinite().all() and terms.points.matrix.isfinite().all()


@pytest.mark.parametrize("by", [TORCH32, NUMBA], ids=str)
def test_a_rim_is_an_outline_and_a_missing_mask_none(by):
    """An open mesh ends where a face has no neighbour."""
    surface, target, _ = problem(by)
    half = replace(surface, faces=surface.faces[::2], face_uvs=surface.face_uvs[::2])
    R, t = poses(by, torch.zeros(1, 6, dtype=torch.float64))
    whole, open_mesh = (pose_terms(s, target, R, t, None, SCALES) for s in (surface, half))
    assert float(open_mesh.outline.cost) > float(whole.outline.cost) > 0
    assert not pose_terms(
        surface, replace(target, mask=None, distance=None), R, t, None, SCALES
    ).outline.cost.any()


@pytest.mark.parametrize("by", [TORCH64, NUMBA], ids=str)
def test_many_poses_are_as_if_each_were_alone(by):
    steps = some_steps()
    together = terms_at(by, steps)
    for n in range(len(steps)):
        alone = terms_at(by, steps[n : n + 1])
        torch.testing.assert_close(alone.appearance.matrix[0], together.appearance.matrix[n])
        torch.testing.assert_close(alone.outline.gradient[0], together.outline.gradient[n])
        torch.testing.assert_close(alone.overlap[0], together.overlap[n])


@pytest.mark.parametrize("by", [TORCH64, NUMBA], ids=str)
def test_wrong_shapes_are_named(by):
    surface, target, matched = problem(by)
    R, t = poses(by, torch.zeros(1, 6, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"comparable.*\(40, 39\)"):
        pose_terms(surface, replace(target, comparable=target.comparable[:, 1:]), R, t, matched, SCALES)
    with pytest.raises(ValueError, match="t has shape"):
        pose_terms(surface, target, R, t[0], matched, SCALES)
    with pytest.raises((IndexError, RuntimeError)):
        pose_terms(replace(surface, faces=surface.faces + 10_000), target, R, t, matched, SCALES)
