from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.sparse.linalg import eigsh
from torch import Tensor
from turned_solid import LAMP, SIZE, degrees_apart, turned, turned_map
from twins import shading as twin

from tracking3d.estimation.online.mapping.photometric_adjustment import (
    _APPEARANCE_SCALE,
    _evaluate,
    _problem,
    _State,
    fit_jointly,
    refine_without_points,
)
from tracking3d.estimation.online.optimization import shape_basis
from tracking3d.estimation.online.optimization.kernels.shading import Sights, shade
from tracking3d.estimation.online.optimization.shading import normal_equations
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.shape import unfold
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.rendering import render

ANGLES = [0.0, 12.0, 24.0, 36.0]
WEIGHTS = FitWeights()


def disturbed(object_map: ObjectMap, degrees: float) -> ObjectMap:
    """Every keyframe but the first turned away about a slanting axis."""
    slanting = rotation_about(torch.tensor([1.0, 1.0, 0.3]), degrees)
    views = [
        replace(view, pose=from_matrix(slanting @ view.pose.R, view.pose.translation))
        for view in object_map.keyframes[1:]
    ]
    return replace(object_map, keyframes=(object_map.keyframes[0], *views))


def errors(object_map: ObjectMap, angles: list[float] = ANGLES) -> list[float]:
    return [
        degrees_apart(view.pose, turned(angle))
        for view, angle in zip(object_map.keyframes, angles, strict=True)
    ]


def evaluated(object_map: ObjectMap, count: int = 20) -> tuple[_State, ShapeBasis]:
    modes = ShapeBasis.of(object_map.shape, count)
    poses = Pose.stack([view.pose for view in object_map.keyframes])
    problem = _problem(object_map, modes, WEIGHTS)
    return _evaluate(problem, object_map.vertices, poses.R, poses.translation), modes


def equations(object_map: ObjectMap, factor: float = 1.0) -> tuple[Tensor, Tensor]:
    state, modes = evaluated(object_map)
    matrix, gradient = normal_equations(state.faces, state.outlines, factor, state.R, state.t, modes)
    return torch.from_numpy(matrix), torch.from_numpy(gradient)


def surface_distance(vertices: Tensor, truth: ObjectMap) -> float:
    """Mean distance to the true surface; where along it a vertex lies, no picture tells."""
    surface = trimesh.Trimesh(truth.vertices, truth.shape.faces, process=False)
    return float(trimesh.proximity.closest_point_naive(surface, vertices.numpy())[1].mean())


def test_modes_are_orthonormal_and_the_lowest_does_not_bend() -> None:
    object_map = turned_map([0.0])
    modes = ShapeBasis.of(object_map.shape, 20)
    count = len(modes.bending)
    assert torch.allclose(modes.vectors.T @ modes.vectors, torch.eye(count, dtype=torch.float64), atol=1e-8)
    laplacian = object_map.shape.laplacian.to_dense().double() @ modes.vectors
    assert torch.allclose(laplacian.square().sum(0), modes.bending, atol=1e-8)
    assert float(modes.bending[0]) < 1e-8 < float(modes.bending[5])


def test_modes_of_one_eigenvalue_are_taken_together() -> None:
    # A sphere's come in groups; 20 would cut the one of 17 to 21.
    laplacian = turned_map([0.0]).shape.laplacian.to_dense().double()
    bending = torch.linalg.eigvalsh(laplacian.T @ laplacian)
    assert float(bending[20] / bending[19]) < 1 + 1e-9 < 1.01 < float(bending[21] / bending[20])
    assert len(ShapeBasis.of(turned_map([0.0]).shape, 20).bending) == 21
    assert len(ShapeBasis.of(turned_map([0.0]).shape, 21).bending) == 21


def test_the_modes_do_not_depend_on_which_basis_the_eigensolver_finds(monkeypatch) -> None:
    object_map = turned_map([0.0])
    expected = ShapeBasis.of(object_map.shape, 40)

    def turned_eigsh(matrix, k, **rest):
        # What another matrix kernel does: other bases of the same groups, another order within rounding.
        values, vectors = eigsh(matrix, k=k, **rest)
        same = np.abs(values[:, None] - values) < 1e-9 * np.maximum(values[:, None], 1e-6)
        turn = np.linalg.qr(np.random.default_rng(5).standard_normal((k, k)) * same)[0]
        return values, vectors @ turn

    monkeypatch.setattr(shape_basis, "eigsh", turned_eigsh)
    found = ShapeBasis.of(object_map.shape, 40)
    assert torch.allclose(found.vectors, expected.vectors, atol=1e-8)
    assert torch.allclose(found.bending, expected.bending, rtol=1e-8, atol=1e-12)


def test_the_light_of_flat_colours_is_found_exactly() -> None:
    random = np.random.default_rng(1)
    normal = random.standard_normal((300, 4, 3))
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    values = random.random((300, 1, 3)) + normal @ LAMP.double().numpy().T
    rows, nothing = np.arange(1200), np.empty((1200, 3))
    slopes = np.zeros((1200, 6))
    sights = Sights(
        rows // 4, rows % 4, normal.reshape(-1, 3), np.concatenate([values.reshape(-1, 3), slopes], 1),
        np.full(1200, 1 / 3600), nothing, nothing.copy(),
    )  # fmt: skip
    light = np.empty((3, 3))
    loss = shade(sights, np.arange(0, 1201, 4), 0.25, 1e-3 / 3, light)
    assert np.allclose(light, LAMP, atol=0.02)
    assert np.abs(sights.residual).mean() < 0.01
    assert loss < 1e-3


@pytest.mark.parametrize("degrees", [0.0, 5.0, 25.0])
@pytest.mark.parametrize("lit", [True, False])
def test_the_kernels_say_what_the_slow_twin_says(degrees: float, lit: bool) -> None:
    object_map = disturbed(turned_map(ANGLES, lit=lit), degrees)
    state, modes = evaluated(object_map)
    problem, shape = _problem(object_map, modes, WEIGHTS), object_map.shape
    drawn = render(
        object_map.vertices, shape.faces, shape.face_uvs, torch.zeros(1, 8, 8), state.R, state.t, problem.K,
        (SIZE, SIZE),
    )  # fmt: skip
    layers = torch.from_numpy(problem.layers).permute(0, 3, 1, 2)
    expected = twin.shared_faces(drawn, layers, _APPEARANCE_SCALE)
    assert np.array_equal(np.unique(state.faces.sights.face), expected.faces)
    assert state.faces.cost == pytest.approx(expected.cost, rel=1e-4)
    assert np.allclose(state.faces.light, expected.light, atol=1e-4)
    matrix, gradient = normal_equations(state.faces, state.outlines, 4.0, state.R, state.t, modes)
    slow, slope = twin.normal_equations(
        expected, state.outlines, 4.0, state.R, state.t, modes, object_map.shape.faces
    )
    assert np.allclose(matrix, slow, rtol=0, atol=1e-5 * float(slow.abs().max()))
    assert np.allclose(gradient, slope, rtol=0, atol=1e-4 * float(slope.abs().max()))


def test_moving_the_object_is_moving_all_views() -> None:
    # An exact property of the derivatives: both sides are the same motion on every screen.
    object_map = disturbed(turned_map(ANGLES), 5.0)
    state, modes = evaluated(object_map)
    _, gradient = equations(object_map)
    count = 3 * len(modes.bending)
    by_view = gradient[count : count + 6 * len(ANGLES)].reshape(-1, 2, 3)
    by_shift = gradient[:3] / modes.vectors[0, 0]  # the lowest mode is the same at all vertices
    by_views = torch.einsum("bij,bi->j", state.R.double(), by_view[:, 0])
    assert float(by_shift.norm()) > 1e-3
    assert torch.allclose(by_shift, by_views, atol=1e-3 * float(by_shift.norm()))


def test_the_cost_falls_along_the_gradient_by_about_as_much_as_it_says() -> None:
    object_map = disturbed(turned_map(ANGLES, lit=False), 4.0)
    state, modes = evaluated(object_map)
    _, gradient = equations(object_map)
    _, outlines = equations(object_map, 0.0)
    count = 3 * len(modes.bending)
    gradient = (gradient - outlines)[count + 6 : count + 12].float()
    step = -0.01 * gradient / gradient.norm()
    view = object_map.keyframes[1]
    R = rotation_about(step[3:], float(torch.rad2deg(step[3:].norm()))) @ view.pose.R
    moved = replace(view, pose=from_matrix(R, view.pose.translation + step[:3]))
    after, _ = evaluated(
        replace(object_map, keyframes=(object_map.keyframes[0], moved, *object_map.keyframes[2:]))
    )
    # Not exactly: which faces are seen, and how large, changes too.
    assert 0.5 < (state.faces.cost - after.faces.cost) / (0.01 * float(gradient.norm())) < 2.0


def test_a_lit_and_turning_solid_costs_next_to_nothing_at_the_truth() -> None:
    plain, _ = evaluated(turned_map(ANGLES, textured=False))
    dark, _ = evaluated(turned_map(ANGLES, textured=False, lit=False))
    assert plain.faces.cost < 0.05
    assert dark.faces.cost < 0.05


@pytest.mark.parametrize("count", [40, 80])
@pytest.mark.parametrize("lit", [True, False])
def test_disturbed_poses_and_a_round_shape_return_to_the_truth(count: int, lit: bool) -> None:
    truth = turned_map(ANGLES, lit=lit)
    start = replace(disturbed(truth, 6.0), vertices=truth.shape.rest)
    modes = ShapeBasis.of(truth.shape, count)
    _, first = fit_jointly(start, modes, WEIGHTS, 0)
    found, cost = fit_jointly(start, modes, WEIGHTS, 25)
    assert cost < 0.2 * first
    assert max(errors(found)) < 3.0 < 5.9 < max(errors(start))
    assert surface_distance(found.vertices, truth) < 0.7 * surface_distance(start.vertices, truth)


def test_a_start_that_differs_by_rounding_ends_at_the_same_place() -> None:
    truth = turned_map(ANGLES)
    start = replace(disturbed(truth, 6.0), vertices=truth.shape.rest)
    noise = 1e-6 * torch.randn(start.vertices.shape, generator=torch.Generator().manual_seed(3))
    modes = ShapeBasis.of(truth.shape, 40)
    found, cost = fit_jointly(start, modes, WEIGHTS, 25)
    other, other_cost = fit_jointly(replace(start, vertices=start.vertices + noise), modes, WEIGHTS, 25)
    assert abs(other_cost / cost - 1) < 0.01
    apart = [degrees_apart(a.pose, b.pose) for a, b in zip(found.keyframes, other.keyframes, strict=True)]
    assert max(apart) < 0.3


def test_the_first_pose_stays() -> None:
    object_map = disturbed(turned_map(ANGLES[:3]), 4.0)
    found, _ = fit_jointly(object_map, ShapeBasis.of(object_map.shape, 20), WEIGHTS, 3)
    assert torch.equal(found.keyframes[0].pose.matrix(), object_map.keyframes[0].pose.matrix())
    assert not torch.equal(found.keyframes[1].pose.matrix(), object_map.keyframes[1].pose.matrix())


def test_keyframes_that_take_no_part_do_not_move() -> None:
    object_map = disturbed(turned_map(ANGLES), 4.0)
    found = refine_without_points(object_map, [0, 1, 3], WEIGHTS)
    assert found.keyframes[2] is object_map.keyframes[2]
    assert errors(found)[1] < 2.0
    assert errors(found)[3] < 2.0
    assert refine_without_points(object_map, [2], WEIGHTS) is object_map


def test_a_view_without_a_mask_takes_part_by_what_it_shows() -> None:
    object_map = disturbed(turned_map(ANGLES), 4.0)
    view = object_map.keyframes[2]
    empty = replace(view.observation, mask=torch.zeros(SIZE, SIZE), has_mask=False)
    keyframes = (
        *object_map.keyframes[:2],
        replace(view, observation=empty, mask=None),
        object_map.keyframes[3],
    )
    found, cost = fit_jointly(
        replace(object_map, keyframes=keyframes), ShapeBasis.of(object_map.shape), WEIGHTS, 12
    )
    assert np.isfinite(cost)
    assert errors(found)[2] < 2.0


def test_a_fit_does_not_keep_a_fold() -> None:
    truth = turned_map(ANGLES)
    vertices = truth.vertices.clone()
    near = torch.exp(-vertices[:, :2].square().sum(1) / 0.1) * (vertices[:, 2] > 0)
    vertices[:, 0] += 1.6 * near
    folded = replace(truth, vertices=vertices)
    assert not torch.equal(unfold(truth.shape, vertices), vertices)
    fitted, _ = fit_jointly(folded, ShapeBasis.of(truth.shape), WEIGHTS, 6)
    assert torch.equal(unfold(truth.shape, fitted.vertices), fitted.vertices)
