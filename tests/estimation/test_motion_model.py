"""Where a frame's pose starts: last pose, constant velocity, and where the mask is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from short_runs import quick_solver, run, short_clip, true_mask

from tracking3d.estimation.observation import mask_box, projected_box
from tracking3d.estimation.paper.solver import PaperState, candidate_poses, shift_to_mask
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d_bench.evaluation.metrics import mask_iou


@pytest.fixture(scope="module")
def belief() -> PaperState:
    """After one frame."""
    return run(quick_solver("paper"), range(1))[1]


def turned(pose: Pose, degrees: float, shift: tuple[float, ...] = (0, 0, 0)) -> Pose:
    R = rotation_about(torch.tensor([0.0, 1.0, 0.0]), degrees) @ pose.R
    return from_matrix(R, pose.translation + torch.tensor(shift, dtype=torch.float32))


def centroid(mask: np.ndarray) -> np.ndarray:
    return np.argwhere(mask).mean(0)[::-1]


def test_without_a_motion_to_go_on_with_the_views_of_the_keyframes_are_tried(belief):
    [keyframe] = belief.keyframes
    away = turned(belief.last[0], 40)
    lost = replace(belief, last=(away, 5), before=None)
    assert candidate_poses(lost, 6, None) == [away, keyframe.pose]


def test_where_nothing_is_known_there_is_only_the_last_pose(belief):
    assert candidate_poses(replace(belief, keyframes=()), 1, None) == [belief.last[0]]


def test_the_last_motion_goes_on(belief):
    last = belief.last[0]
    moving = replace(belief, before=(last, 4), last=(turned(last, 10, (0.1, 0, 0)), 5))
    still, ahead = candidate_poses(moving, 6, None)
    assert still is moving.last[0]
    torch.testing.assert_close(ahead.matrix(), turned(last, 20, (0.2, 0, 0)).matrix(), rtol=0, atol=1e-5)


def test_the_last_motion_is_a_frame_s_share_of_what_lies_between(belief):
    last = belief.last[0]
    moving = replace(belief, before=(last, 2), last=(turned(last, 10, (0.1, 0, 0)), 4))
    after_one, after_two = (candidate_poses(moving, index, None)[1] for index in (5, 6))
    torch.testing.assert_close(after_one.matrix(), turned(last, 15, (0.15, 0, 0)).matrix(), rtol=0, atol=1e-5)
    torch.testing.assert_close(after_two.matrix(), turned(last, 20, (0.2, 0, 0)).matrix(), rtol=0, atol=1e-5)


def test_after_a_long_gap_the_motion_is_not_trusted_forever(belief):
    last = belief.last[0]
    moving = replace(belief, before=(last, 4), last=(turned(last, 10, (0.1, 0, 0)), 5))
    ahead = candidate_poses(moving, 105, None)[1]
    torch.testing.assert_close(ahead.matrix(), turned(last, 40, (0.4, 0, 0)).matrix(), rtol=0, atol=1e-5)


def test_each_is_also_tried_where_the_mask_is(belief):
    moving = replace(belief, before=(belief.last[0], 4), last=(turned(belief.last[0], 10), 5))
    assert len(candidate_poses(moving, 6, true_mask(0))) == 4
    assert len(candidate_poses(moving, 6, np.zeros_like(true_mask(0)))) == 2


@pytest.mark.parametrize("shift", [(0, 0), (12, -6), (-15, 10)])
@pytest.mark.parametrize("scale", [1.0, 1.15, 0.9])
def test_a_pose_moved_to_a_mask_has_its_centroid_and_area(belief, shift, scale):
    pose = belief.last[0]
    depth = float(pose.translation[2])
    camera = short_clip().camera
    offset = torch.tensor([shift[0] / camera.fx * depth, shift[1] / camera.fy * depth, 0.0])
    mask = belief.silhouette(Pose((pose.translation + offset) * scale, pose.quaternion))
    found = belief.silhouette(shift_to_mask(belief, pose, mask))
    assert np.linalg.norm(centroid(found) - centroid(mask)) < 1.5
    assert found.sum() == pytest.approx(mask.sum(), rel=0.08)
    assert torch.equal(shift_to_mask(belief, pose, mask).quaternion, pose.quaternion)


def test_a_pose_out_of_sight_is_brought_back_to_the_mask(belief):
    away = Pose(belief.last[0].translation + torch.tensor([100.0, 30.0, 0.0]), belief.last[0].quaternion)
    found = belief.silhouette(shift_to_mask(belief, away, true_mask(0)))
    assert np.linalg.norm(centroid(found) - centroid(true_mask(0))) < 3


def test_a_pose_behind_the_camera_stays_a_number(belief):
    behind = Pose(-belief.last[0].translation, belief.last[0].quaternion)
    assert torch.isfinite(shift_to_mask(belief, behind, true_mask(0)).translation).all()


def test_depth_changes_by_a_quarter_at_most(belief):
    speck = np.zeros_like(true_mask(0))
    speck[40, 50] = True
    depth = belief.last[0].translation[2]
    assert shift_to_mask(belief, belief.last[0], speck).translation[2] == pytest.approx(1.25 * depth)


def test_the_projected_box_is_that_of_the_silhouette(belief):
    box = projected_box(belief.vertices, belief.camera, belief.last[0])
    silhouette = belief.silhouette(belief.last[0])
    np.testing.assert_allclose(box, mask_box(silhouette), atol=1.5)
    assert mask_iou(silhouette, true_mask(0)) > 0.7


@pytest.mark.parametrize("gap", [0.1, 0.01, 0.0015])
def test_the_box_of_an_object_right_before_the_camera_ends_with_the_frame(belief, gap):
    nearest = float((belief.vertices @ belief.last[0].R.T)[:, 2].min())
    pose = Pose(torch.tensor([0.0, 0.0, gap - nearest]), belief.last[0].quaternion)
    assert projected_box(belief.vertices, belief.camera, pose) == (0, 0, 100, 80)


@pytest.mark.parametrize("shift", [(100.0, 0.0), (-100.0, 0.0), (0.0, 100.0), (float("nan"), 0.0)])
def test_an_object_beside_the_frame_has_no_box(belief, shift):
    away = torch.tensor([*shift, 5.0])
    assert projected_box(belief.vertices, belief.camera, Pose(away, belief.last[0].quaternion)) is None


@pytest.mark.parametrize("depth", [0.5, 0.0, -3.0])
def test_an_object_around_or_behind_the_camera_has_no_box(belief, depth):
    pose = Pose(torch.tensor([0.0, 0.0, depth]), belief.last[0].quaternion)
    assert projected_box(belief.vertices, belief.camera, pose) is None


def test_the_box_of_a_mask_spans_its_outer_pixels():
    mask = np.zeros((20, 30), bool)
    mask[4:9, 10] = True
    mask[6, 10:15] = True
    assert mask_box(mask) == (10, 4, 5, 5)
