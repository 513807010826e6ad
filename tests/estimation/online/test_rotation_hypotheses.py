from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from turned_solid import CAMERA, SIZE, degrees_apart, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.initialization import initial_map
from tracking3d.estimation.online.initialization.initial_map import (
    DIRECTIONS,
    PROFILES,
    TURN,
    continue_rotation,
    initialize_without_points,
    restart_without_points,
    reverse_rotations,
    rotation_hypotheses,
    vary_rotations,
)
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about


def box_mask(left: int, top: int, side: int) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), dtype=np.bool_)
    mask[top : top + side, left : left + side] = True
    return mask


def test_hypotheses_turn_all_the_time_late_or_early_in_every_direction_and_one_does_not() -> None:
    views = list(turned_map([0.0, 0.0, 0.0]).keyframes)
    found = rotation_hypotheses(views, CAMERA)
    assert len(found) == 1 + DIRECTIONS * len(PROFILES)
    assert len({name for name, _ in found}) == 1 + DIRECTIONS
    halves = []
    for _, poses in found[1:]:
        assert degrees_apart(poses[0], views[0].pose) == pytest.approx(0.0, abs=0.1)
        assert degrees_apart(poses[2], views[0].pose) == pytest.approx(TURN, abs=0.1)
        halves.append(degrees_apart(poses[1], views[0].pose))
    wanted = [TURN / 2, 0.0, TURN] * DIRECTIONS
    assert halves == pytest.approx(wanted, abs=0.1)
    assert degrees_apart(found[0][1][2], views[0].pose) == pytest.approx(0.0, abs=0.1)


def test_translations_follow_the_masks() -> None:
    first, second = turned_map([0.0, 0.0]).keyframes
    depth = float(first.pose.translation[2])
    views = [replace(first, mask=box_mask(20, 20, 16)), replace(second, mask=box_mask(26, 17, 16))]
    beside = rotation_hypotheses(views, CAMERA)[0][1][1].translation
    expected = torch.tensor([6 / CAMERA.fx * depth, -3 / CAMERA.fy * depth, depth])
    assert torch.allclose(beside, expected, atol=1e-5)
    # Half as wide is twice as far away.
    views[1] = replace(second, mask=box_mask(24, 24, 8))
    assert float(rotation_hypotheses(views, CAMERA)[0][1][1].translation[2]) == pytest.approx(2 * depth)
    for nothing in (None, box_mask(0, 0, 0)):
        views[1] = replace(second, mask=nothing)
        assert torch.equal(rotation_hypotheses(views, CAMERA)[0][1][1].translation, first.pose.translation)


def test_a_start_without_points_begins_where_the_object_is_by_then(monkeypatch) -> None:
    truth = turned_map([0.0, 7.0, 14.0, 21.0])
    beside = Pose(
        truth.keyframes[0].pose.translation + torch.tensor([1.5, -1.0, 2.0]), torch.tensor([1.0, 0, 0, 0])
    )
    views = [replace(view, pose=beside) for view in truth.keyframes]
    monkeypatch.setattr(initial_map, "fit_jointly", lambda object_map, *_: (object_map, 0.0))
    (start,) = initialize_without_points(replace(truth, keyframes=()), CAMERA, views, FitWeights())
    first = start.object_map.keyframes[0]
    assert first.mask is not None
    drawn = truth.silhouette(first.pose, CAMERA)
    assert (drawn & first.mask).sum() / (drawn | first.mask).sum() > 0.7


def test_varied_rotations_are_near_the_one_they_come_from_and_keep_the_first_view() -> None:
    views = list(turned_map([0.0, 20.0, 40.0]).keyframes)
    poses = [view.pose for view in views]
    varied = vary_rotations(views, poses, CAMERA)
    assert all(degrees_apart(one[0], poses[0]) == pytest.approx(0.0, abs=0.1) for one in varied)
    extents = sorted(degrees_apart(one[2], one[0]) for one in varied)
    assert extents[0] == pytest.approx(0.6 * 40, abs=0.1)
    assert extents[-1] == pytest.approx(1.6 * 40, abs=0.1)
    apart = [degrees_apart(one[2], poses[2]) for one in varied]
    assert all(10 < angle < 30 for angle in apart)


def test_a_reversed_rotation_has_the_same_outlines_of_a_distant_object() -> None:
    views = list(turned_map([0.0, 15.0, 30.0]).keyframes)
    reverse = reverse_rotations(views, CAMERA)
    assert degrees_apart(reverse[2], views[0].pose) == pytest.approx(30.0, abs=0.1)
    assert degrees_apart(reverse[2], views[2].pose) == pytest.approx(60.0, abs=0.1)
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0]))
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(3))
    for view, other in zip(views, reverse, strict=True):
        there = points @ view.pose.R.T
        reflected = points @ flip @ other.R.T
        assert torch.allclose(there[:, :2], reflected[:, :2], atol=1e-4)


@pytest.mark.parametrize("angles", [[0, 6, 12, 18, 24, 30, 36], [0, 6, 12, 18, 12, 6, 0]])
def test_a_rotation_that_tracking_lost_goes_on_as_in_the_first_views_or_comes_back(
    angles: list[float],
) -> None:
    views = list(turned_map([float(angle) for angle in angles], step=6).keyframes)
    true = [view.pose for view in views]
    # Tracking follows the first twelve frames, and no further.
    lagging = [
        replace(view, pose=replace(view.pose, quaternion=true[min(n, 2)].quaternion))
        for n, view in enumerate(views)
    ]
    found = continue_rotation(lagging, CAMERA)
    off = [max(degrees_apart(a, b) for a, b in zip(poses, true, strict=True)) for poses in found]
    assert max(degrees_apart(a.pose, b) for a, b in zip(lagging, true, strict=True)) >= 11.9
    assert min(off) < 1


def test_a_rotation_between_the_directions_that_are_tried_is_found() -> None:
    truth = turned_map([0.0, 9.0, 18.0, 27.0, 36.0])
    roll = rotation_about(torch.tensor([0.0, 0.0, 1.0]), 70.0)
    views = [replace(view, pose=from_matrix(roll, view.pose.translation)) for view in truth.keyframes]
    # What the fit is asked for: a turn about none of the eight axes.
    wanted = [views[0].pose] + [
        from_matrix(rotation_about(torch.tensor([1.0, 0.4, 0.0]), angle) @ roll, views[0].pose.translation)
        for angle in (8.75, 17.5, 26.25, 35.0)
    ]

    def off(object_map: ObjectMap) -> float:
        return sum(
            degrees_apart(view.pose, pose) for view, pose in zip(object_map.keyframes, wanted, strict=True)
        )

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial_map, "place_on_mask", lambda *_: views[0].pose)
        patch.setattr(initial_map, "fit_jointly", lambda object_map, *_: (object_map, off(object_map)))
        (start,) = initialize_without_points(replace(truth, keyframes=()), CAMERA, views, FitWeights())
        best = min(
            off(replace(truth, keyframes=initial_map._with_poses(views, poses)))
            for _, poses in rotation_hypotheses(views, CAMERA)
        )
    assert off(start.object_map) < 0.3 * best


def map_astray(truth: ObjectMap) -> ObjectMap:
    """The prototype at poses that turn in the other sense."""
    poses = reverse_rotations(list(truth.keyframes), CAMERA)
    keyframes = (replace(view, pose=pose) for view, pose in zip(truth.keyframes, poses, strict=True))
    return replace(truth, vertices=truth.shape.rest, keyframes=tuple(keyframes), pointless=True)


def test_a_map_is_begun_again_only_if_that_is_clearly_better(monkeypatch) -> None:
    truth = turned_map([0.0, 10.0, 20.0, 30.0, 40.0])
    astray, base = map_astray(truth), [100.0]

    def off(object_map: ObjectMap, *_) -> tuple[ObjectMap, float]:
        pairs = zip(object_map.keyframes, truth.keyframes, strict=True)
        return object_map, base[0] + sum(degrees_apart(a.pose, b.pose) for a, b in pairs)

    monkeypatch.setattr(initial_map, "fit_jointly", off)
    found = restart_without_points(astray, CAMERA, FitWeights())
    assert degrees_apart(found.keyframes[-1].pose, truth.keyframes[-1].pose) < 1
    # Two that turn differently, and explain the views alike, replace nothing.
    monkeypatch.setattr(initial_map, "fit_jointly", lambda object_map, *_: (object_map, alike(object_map)))

    def alike(object_map: ObjectMap) -> float:
        pairs = zip(object_map.keyframes, astray.keyframes, strict=True)
        return 50.0 if any(degrees_apart(a.pose, b.pose) > 1 for a, b in pairs) else 100.0

    assert restart_without_points(astray, CAMERA, FitWeights()) is astray
    monkeypatch.setattr(initial_map, "fit_jointly", off)
    base[0] = 1e5
    assert restart_without_points(astray, CAMERA, FitWeights()) is astray


def test_a_map_that_hardly_turns_has_no_rival_and_is_begun_again_if_that_is_clearly_better(
    monkeypatch,
) -> None:
    little = turned_map([0.0, 0.1, 0.2, 0.3, 0.4])

    def off(object_map: ObjectMap, *_) -> tuple[ObjectMap, float]:
        last = object_map.keyframes[-1].pose
        return object_map, 1 + degrees_apart(last, little.keyframes[-1].pose)

    monkeypatch.setattr(initial_map, "fit_jointly", off)
    found = restart_without_points(map_astray(little), CAMERA, FitWeights())
    assert degrees_apart(found.keyframes[-1].pose, little.keyframes[-1].pose) < 0.1


@pytest.mark.slow
def test_a_map_that_turns_the_wrong_way_is_begun_again() -> None:
    truth = turned_map([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
    found = restart_without_points(map_astray(truth), CAMERA, FitWeights(smoothness=30.0))
    assert degrees_apart(found.keyframes[-1].pose, truth.keyframes[-1].pose) < 30  # of 120 before
    right = replace(truth, pointless=True)
    assert restart_without_points(right, CAMERA, FitWeights(smoothness=30.0)) is right


@pytest.mark.slow
def test_a_start_without_points_finds_how_the_object_turned() -> None:
    angles = [0.0, 7.0, 14.0, 21.0, 28.0, 35.0, 42.0]
    truth = turned_map(angles)
    landmarks = np.ones((3, 3))
    points = FollowedPoints(np.arange(3), np.full((3, 2), 5.0, np.float32))
    views = [replace(view, pose=truth.keyframes[0].pose, points=points) for view in truth.keyframes]
    object_map = replace(
        truth,
        vertices=truth.shape.rest,
        keyframes=(),
        landmarks=landmarks,
        candidate=np.zeros(3, dtype=np.bool_),
    )
    (start,) = initialize_without_points(object_map, CAMERA, views, FitWeights(smoothness=30.0))
    found = start.object_map.keyframes
    assert [view.index for view in found] == [view.index for view in views]
    off = [degrees_apart(a.pose, b.pose) for a, b in zip(found, truth.keyframes, strict=True)]
    # Of 42 degrees; the depth of a smooth solid trades against its turn.
    assert max(off) < 12.0
    # What was followed told nothing: it is not taken over.
    assert not np.isfinite(start.object_map.landmarks).any()
    assert not any(len(view.points) for view in found)
