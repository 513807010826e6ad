"""Which frames stay in the optimization, on histories written down by hand."""

from __future__ import annotations

import pytest
import torch

from tracking3d.config.models import KeyframeConfig
from tracking3d.estimation.paper.solver import KeyframeCandidate, select_keyframes, thin_out
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

TAU = 0.2
OBJECT_SIZE = 1.8


def frame(
    degrees: float = 0.0, x: float = 0.0, silhouette: float = 0.1, appearance: float = 0.1
) -> KeyframeCandidate:
    axis = torch.tensor([0.0, 1.0, 0.0])
    pose = from_matrix(rotation_about(axis, degrees), torch.tensor([x, 0.0, 3.0]))
    return KeyframeCandidate(pose, silhouette, appearance)


def select(*candidates: KeyframeCandidate, **criteria) -> list[int]:
    return select_keyframes(candidates, OBJECT_SIZE, TAU, KeyframeConfig.model_validate(criteria))


def test_the_first_consistent_frame_is_a_keyframe():
    assert select(frame()) == [0]


@pytest.mark.parametrize(("degrees", "kept"), [(44.9, [0]), (45.1, [0, 1]), (-45.1, [0, 1]), (180.0, [0, 1])])
def test_a_frame_that_turned_more_than_45_degrees_is_a_new_view(degrees, kept):
    assert select(frame(), frame(degrees)) == kept


@pytest.mark.parametrize(("x", "kept"), [(0.89, [0]), (0.91, [0, 1]), (-0.91, [0, 1])])
def test_a_frame_that_moved_more_than_half_the_object_is_a_new_view(x, kept):
    assert select(frame(), frame(x=x)) == kept


def test_the_thresholds_of_a_new_view_can_be_set():
    assert select(frame(), frame(12), rotation=10) == [0, 1]
    assert select(frame(), frame(x=0.3), translation=0.1) == [0, 1]


@pytest.mark.parametrize(("silhouette", "kept"), [(0.29, [0, 1]), (0.3, [0]), (float("nan"), [0])])
def test_a_keyframe_agrees_with_its_mask(silhouette, kept):
    assert select(frame(), frame(60, silhouette=silhouette)) == kept


@pytest.mark.parametrize(("appearance", "kept"), [(0.19, [0, 1]), (0.2, [0]), (float("nan"), [0])])
def test_a_keyframe_is_explained_below_tau(appearance, kept):
    assert select(frame(), frame(60, appearance=appearance)) == kept


def test_the_limits_of_both_losses_can_be_set():
    assert select(frame(silhouette=0.4), silhouette=0.5) == [0]
    assert select(frame(appearance=0.3), features=0.35) == [0]
    assert select(frame(appearance=0.1), features=0.05) == []


def test_new_views_are_measured_from_the_latest_keyframe_not_from_the_first():
    assert select(frame(0), frame(50), frame(80), frame(100)) == [0, 1, 3]
    assert select(frame(0), frame(50), frame(0)) == [0, 1, 2]


def test_a_keyframe_that_no_longer_agrees_falls_out():
    assert select(frame(0), frame(50), frame(100)) == [0, 1, 2]
    assert select(frame(0), frame(50, silhouette=0.35), frame(100)) == [0, 2]
    assert select(frame(0), frame(50, appearance=0.25), frame(100)) == [0, 2]


def test_a_keyframe_whose_pose_came_near_the_one_before_falls_out():
    assert select(frame(0), frame(30), frame(100)) == [0, 2]


def test_what_is_a_new_view_is_judged_without_those_that_fell_out():
    assert select(frame(0), frame(50), frame(85)) == [0, 1]
    assert select(frame(0), frame(50, silhouette=0.35), frame(85)) == [0, 2]


def test_no_frame_need_be_a_keyframe():
    assert select(frame(silhouette=0.5), frame(90, appearance=0.9)) == []


def test_the_six_most_recent_are_kept():
    assert select(*(frame(50 * n) for n in range(9))) == [3, 4, 5, 6, 7, 8]
    assert select(*(frame(50 * n) for n in range(9)), maximum=2) == [7, 8]


def test_history_of_a_steady_turn():
    poses: list[tuple[int, KeyframeCandidate]] = []
    for index in range(73):
        candidates = [*poses, (index, frame(10 * index))]
        poses = [candidates[i] for i in select(*(candidate for _, candidate in candidates))]
    assert [index for index, _ in poses] == [45, 50, 55, 60, 65, 70]


def test_the_first_frame_can_be_made_to_stay_whatever_happens():
    broken = frame(silhouette=0.9, appearance=0.9)
    assert select(broken, frame(60)) == [1]
    assert select(broken, frame(60), keep_first=True) == [0, 1]
    assert select(broken, frame(20), keep_first=True) == [0]


def test_with_the_first_frame_kept_half_are_recent_and_half_spread():
    turning = [frame(50 * n) for n in range(12)]
    assert select(*turning, keep_first=True) == [0, 4, 8, 9, 10, 11]
    assert select(*turning, keep_first=True, maximum=12) == list(range(12))
    assert select(*turning, keep_first=True, maximum=1) == [0]


@pytest.mark.parametrize("maximum", range(1, 9))
@pytest.mark.parametrize("count", [9, 10, 17, 40])
def test_thinning_out_keeps_the_first_and_the_recent_half(count, maximum):
    kept = list(range(100, 100 + count))
    thinned = thin_out(kept, maximum)
    assert len(thinned) == maximum
    assert thinned == sorted(set(thinned))
    assert set(thinned) <= set(kept)
    assert thinned[0] == kept[0]
    assert thinned[maximum - maximum // 2 :] == kept[len(kept) - maximum // 2 :]


def test_thinning_out_spreads_the_older_half_evenly():
    assert thin_out(list(range(20)), 8) == [0, 5, 10, 15, 16, 17, 18, 19]


def test_poses_may_be_given_by_either_quaternion():
    turned = frame(60)
    opposite = KeyframeCandidate(Pose(turned.pose.translation, -turned.pose.quaternion), 0.1, 0.1)
    assert select(turned, opposite) == [0]
