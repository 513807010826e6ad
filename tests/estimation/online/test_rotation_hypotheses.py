from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from turned_solid import CAMERA, SIZE, degrees_apart, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.initialization import initial_map
from tracking3d.estimation.online.initialization.initial_map import initialize_without_points
from tracking3d.estimation.online.initialization.rotation_hypotheses import (
    DIRECTIONS,
    TURNS,
    rotation_hypotheses,
)
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.geometry.pose import Pose


def box_mask(left: int, top: int, side: int) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), dtype=np.bool_)
    mask[top : top + side, left : left + side] = True
    return mask


def test_hypotheses_turn_steadily_in_every_direction_and_one_does_not() -> None:
    views = list(turned_map([0.0, 0.0, 0.0]).keyframes)
    found = rotation_hypotheses(views, CAMERA)
    assert len(found) == 1 + DIRECTIONS * len(TURNS)
    assert len({name for name, _ in found}) == 1 + DIRECTIONS
    angles = []
    for _, poses in found:
        assert degrees_apart(poses[0], views[0].pose) == pytest.approx(0.0, abs=0.1)
        half, whole = (degrees_apart(pose, views[0].pose) for pose in poses[1:])
        assert half == pytest.approx(whole / 2, abs=0.1)
        angles.append(whole)
    assert sorted(angles)[0] == pytest.approx(0.0, abs=0.1)
    assert sorted(angles)[1:] == pytest.approx(sorted(TURNS * DIRECTIONS), abs=0.1)


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
    views[1] = replace(second, mask=None)
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
