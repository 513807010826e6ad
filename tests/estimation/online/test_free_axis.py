from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d
from turned_solid import degrees_apart

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapper import adopt_free_axis
from tracking3d.estimation.online.mapping.free_axis import (
    as_surface_of_revolution,
    find_free_axis,
    look_revolved,
)
from tracking3d.estimation.online.mapping.global_refinement import fit_keyframes
from tracking3d.estimation.online.optimization.revolution import FreeAxis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.estimation.shape import Shape
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.geometry.prototypes import ellipsoid
from tracking3d.rendering import TexelMap, render
from tracking3d.results.checkpoint.serialization import TreeFolder

SIZE, FINE = 96, 3
UPRIGHT = np.array([0.0, 1.0, 0.0])
LAMP = torch.tensor([0.2, -0.2, -0.3])
WINDOW = Window(0, 0, SIZE, SIZE)
CAMERA = Camera.from_fov(SIZE, SIZE)


def pear(shape: Shape, handle: float = 0.0) -> Tensor:
    """A surface of revolution about the upright axis, or one with something at its side."""
    x, y, z = shape.rest.unbind(1)
    radius = 0.55 + 0.2 * torch.cos(2.5 * (y + 0.4))
    side = torch.exp(-((x - 1) ** 2 + y**2 + z**2) / 0.1)
    return torch.stack([(radius + handle * side) * x, y, radius * z], 1)


def seen(index: int, vertices: Tensor, shape: Shape, pose: Pose, marks: float) -> Observation:
    K = torch.tensor(WINDOW.K(CAMERA)).float()
    fine = K * torch.tensor([[FINE], [FINE], [1.0]])
    fine[:2, 2] += (FINE - 1) / 2
    drawn = render(
        vertices, shape.faces, shape.face_uvs, torch.zeros(1, 8, 8), pose.R[None], pose.translation[None], fine[None],
        (FINE * SIZE, FINE * SIZE),
    )  # fmt: skip
    on_object = (drawn.points - pose.translation) @ pose.R
    mark = marks * ((on_object[:, 0] - 0.3).abs() < 0.04) * (on_object[:, 1].abs() < 0.3)
    colour = (0.5 + drawn.normals @ LAMP - mark)[:, None].expand(-1, 3)
    inside = (drawn.face_index >= 0).float()
    picture = torch.where(inside > 0, drawn.image(colour)[0], 0.4)
    image, mask = avg_pool2d(picture, FINE), avg_pool2d(inside, FINE)[0]
    large = torch.nn.functional.interpolate(image[None], scale_factor=2.0, mode="bilinear")[0]
    return Observation(
        index, WINDOW, K, large, image, torch.ones(SIZE, SIZE), mask, torch.zeros(SIZE, SIZE), True
    )


def tumbling(handle: float = 0.0, marks: float = 0.0, count: int = 8) -> ObjectMap:
    """Views of a pear that tumbles, as a map without points at the true poses."""
    shape = Shape.of(ellipsoid(np.array([1.0, 1.0, 1.0]), np.eye(3), 6), False, torch.device("cpu"))
    vertices, views = pear(shape, handle), []
    for index in range(count):
        turn = rotation_about(torch.tensor([1.0, 0.2, 0.0]), 10.0 * index - 35)
        R = rotation_about(torch.tensor([0.0, 0.3, 1.0]), 12.0 * index) @ turn
        pose = from_matrix(R, torch.tensor([0.1, -0.05, 3.6]))
        observation = seen(index, vertices, shape, pose, marks)
        views.append(Keyframe(observation, observation.mask.numpy() > 0.5, pose, FollowedPoints.none()))
    texels = TexelMap.of(shape.face_uvs, 48)
    empty = np.zeros((0, 3)), tuple(views), np.zeros(0, dtype=np.bool_)
    return ObjectMap(shape, texels, vertices, *empty, pointless=True)


def degrees_off(axis: FreeAxis | None) -> float:
    assert axis is not None
    return float(np.degrees(np.arccos(min(1.0, abs(axis.direction @ UPRIGHT)))))


def test_the_axis_of_a_plain_pear_is_found_and_passes_through_it() -> None:
    axis = find_free_axis(tumbling())
    assert degrees_off(axis) < 3
    assert axis is not None and np.linalg.norm(axis.point[[0, 2]]) < 0.05


@pytest.mark.parametrize("change", [{"handle": 0.6}, {"marks": 0.3}])
def test_a_handle_or_a_mark_tells_the_rotation(change) -> None:
    assert find_free_axis(tumbling(**change)) is None


def test_views_of_unknown_poses_tell_whether_rotations_can_be_seen() -> None:
    views = tumbling().keyframes
    assert look_revolved(views)
    assert not look_revolved(views[:5])
    assert not look_revolved(tumbling(handle=0.6).keyframes)


def test_few_views_or_one_with_a_handle_among_the_others_are_not_enough() -> None:
    plain, other = tumbling(), tumbling(handle=0.6).keyframes
    assert find_free_axis(replace(plain, keyframes=plain.keyframes[:5])) is None
    others = [
        replace(view, observation=replace(view.observation, index=90 + n)) for n, view in enumerate(other)
    ]
    assert find_free_axis(plain, others) is None


def test_views_that_the_border_cuts_tell_the_axis_but_not_that_there_is_one() -> None:
    plain = tumbling()

    def cut(view: Keyframe) -> Keyframe:
        seen, inside = view.observation, torch.ones(SIZE, SIZE)
        inside[:, :44] = 0.0
        return replace(view, observation=replace(seen, valid=inside, mask=seen.mask * inside))

    two = replace(plain, keyframes=(*map(cut, plain.keyframes[:2]), *plain.keyframes[2:]))
    assert degrees_off(find_free_axis(two)) < 3
    many = replace(plain, keyframes=(*map(cut, plain.keyframes[:6]), *plain.keyframes[6:]))
    assert find_free_axis(many) is None
    whole = [replace(one, observation=replace(one.observation, index=80)) for one in plain.keyframes]
    assert degrees_off(find_free_axis(many, whole)) < 6


def test_a_wrong_surface_becomes_one_of_revolution_and_its_axis_leans_less() -> None:
    truth, generator = tumbling(), np.random.default_rng(1)
    tilted = [
        replace(view, pose=from_matrix(
            rotation_about(torch.tensor(generator.normal(size=3)).float(), 9.0) @ view.pose.R, view.pose.translation
        ))
        for view in truth.keyframes
    ]  # fmt: skip
    squeezed = truth.vertices * torch.tensor([1.15, 1.0, 0.85])
    found = as_surface_of_revolution(replace(truth, vertices=squeezed, keyframes=tuple(tilted)), FitWeights())
    axis = found.free_axis
    assert axis is not None
    assert torch.allclose(axis.revolved(found.vertices, found.shape.faces), found.vertices, atol=0.03)
    assert np.mean([fit.overlap for fit in fit_keyframes(found)]) > 0.95

    def lean(views: tuple[Keyframe, ...], direction: np.ndarray) -> float:
        pairs = zip(views, truth.keyframes, strict=True)
        cosines = [abs((a.pose.R.numpy() @ direction) @ (b.pose.R.numpy() @ UPRIGHT)) for a, b in pairs]
        return float(np.degrees(np.arccos(np.clip(cosines, 0, 1))).mean())

    assert as_surface_of_revolution(found, FitWeights()) is found  # it is one already
    assert lean(found.keyframes, axis.direction) < 0.6 * lean(tuple(tilted), axis.direction)


def test_what_is_no_surface_of_revolution_loses_its_axis() -> None:
    marked = replace(tumbling(handle=0.6), free_axis=FreeAxis(UPRIGHT, np.zeros(3)))
    found = as_surface_of_revolution(marked, FitWeights())
    assert found.free_axis is None and torch.equal(found.vertices, marked.vertices)


def test_an_untwisted_pose_shows_the_same_and_does_not_turn_about_the_axis() -> None:
    axis = FreeAxis(UPRIGHT, np.array([0.1, 0.0, -0.2]))
    before = from_matrix(rotation_about(torch.tensor([1.0, 0.0, 0.0]), 20.0), torch.tensor([0.0, 0.0, 3.0]))
    spun = rotation_about(torch.tensor([1.0, 0.3, 0.0]), 31.0) @ rotation_about(
        torch.tensor(UPRIGHT).float(), 70.0
    )
    pose = from_matrix(spun, torch.tensor([0.2, 0.1, 3.1]))
    found = axis.untwisted(pose, before)
    for point in (axis.point, axis.point + UPRIGHT):
        there, here = (torch.tensor(point).float() @ one.R.T + one.translation for one in (pose, found))
        assert torch.allclose(there, here, atol=1e-5)
    old, new = (one.R @ torch.tensor(UPRIGHT).float() for one in (before, found))
    leant = float(torch.rad2deg(torch.arccos(old @ new)))
    assert degrees_apart(found, before) == pytest.approx(leant, abs=0.1)
    over = from_matrix(rotation_about(torch.tensor([1.0, 0.0, 0.0]), 170.0), torch.tensor([0.0, 0.0, 3.0]))
    assert axis.untwisted(over, before) is over


def test_the_solver_asks_at_due_keyframes_of_maps_without_points_and_its_state_can_be_kept(tmp_path) -> None:
    plain = tumbling()
    last = plain.keyframes[-1]
    state = Mapped(
        CAMERA, plain, (last.pose, last.index), np.zeros((SIZE, SIZE), np.uint8), FollowedPoints.none(),
        surface=plain.surface(), previous_pose=(last.pose, 0),
    )  # fmt: skip

    def asked(state: Mapped) -> Mapped:
        return adopt_free_axis(state, OnlineConfig())

    with_points = replace(state, object_map=replace(plain, pointless=False))
    for one in (with_points, replace(state, last_pose=(last.pose, 9))):
        assert asked(one) is one
    found = asked(state)
    assert degrees_off(found.object_map.free_axis) < 3 and found.previous_pose is None
    assert found.surface is not None and torch.equal(found.surface.vertices, found.object_map.vertices)
    nubs = [
        replace(view, observation=replace(view.observation, index=90 + n))
        for n, view in enumerate(tumbling(handle=0.6).keyframes)
    ]
    in_sight = replace(found, last_pose=(last.pose, 12), revisable=tuple((view, None) for view in nubs))
    assert asked(replace(in_sight, last_pose=(last.pose, 13))).object_map is found.object_map
    assert asked(replace(in_sight, revisable=())).object_map is found.object_map
    assert asked(in_sight).object_map.free_axis is None
    kept = TreeFolder(tmp_path, OnlineSolver.state_classes)
    axis = kept.read(json.loads(kept.text(found.object_map.free_axis)))
    assert np.array_equal(axis.direction, found.object_map.free_axis.direction)
