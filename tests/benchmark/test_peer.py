"""Views that another system and runs place right: by known poses, and by equal steps of a turntable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d_bench.benchmark import peer
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.truth import Truth

COUNT, STEP = 12, 30.0
TRUTH = Truth("table", tuple(Path(f"{n:06d}.png") for n in range(COUNT)))


def turntable(step: float) -> np.ndarray:
    """``(COUNT, 4, 4)`` poses of an object in any position on a table that is seen from above."""
    axis = np.array([0.0, -0.9, -0.45]) / np.linalg.norm([0.9, 0.45])
    turns = Rotation.from_rotvec(np.outer(np.radians(step) * np.arange(COUNT), axis))
    poses = np.tile(np.eye(4), (COUNT, 1, 1))
    poses[:, :3, :3] = (turns * Rotation.from_euler("xyz", [20, 50, 70], degrees=True)).as_matrix()
    poses[:, 2, 3] = 4
    return poses


def answers(poses, **other) -> Answers:
    known = dict(enumerate(poses))
    return Answers(Path(), range(COUNT), frozenset(range(COUNT)), T_cam_obj=known, **other)


def test_equal_steps_need_no_poses_and_do_not_forgive_the_other_sense():
    right = peer.score_views("a", answers(turntable(STEP)), TRUTH, STEP, None)
    assert (right.placed, right.within_10_deg) == (COUNT, COUNT) and right.largest_of_placed_deg < 0.1
    backwards = peer.score_views("a", answers(turntable(-STEP)), TRUTH, STEP, None)
    assert backwards.placed == COUNT and backwards.within_10_deg <= 2


def test_a_view_that_is_wrong_lost_or_missing_does_not_count_as_right():
    poses = turntable(STEP)
    poses[2, :3, :3] = poses[8, :3, :3]
    given = answers(poses, lost=frozenset({5}), tracked=frozenset({1, 2}))
    given = replace(given, T_cam_obj={n: pose for n, pose in given.T_cam_obj.items() if n != 7})
    for step, truth in ((STEP, TRUTH), (None, replace(TRUTH, T_cam_obj=dict(enumerate(turntable(STEP)))))):
        row = peer.score_views("a", given, truth, step, 1.5)
        assert (row.views, row.placed, row.within_10_deg) == (COUNT, COUNT - 2, COUNT - 3)
        assert (row.tracked, row.tracked_and_wrong, row.processor_seconds) == (2, 1, 1.5)
        assert row.mean_deg == pytest.approx((180 + row.mean_of_placed_deg * (COUNT - 2)) / COUNT, abs=0.1)


def test_a_clip_without_poses_needs_steps():
    with pytest.raises(InputError, match="--step"):
        peer.score_views("a", answers(turntable(STEP)), TRUTH, None, None)


def test_colmap_needs_masks():
    with pytest.raises(InputError, match="no mask of view 000000"):
        peer.run_colmap(TRUTH, range(3), lowered=False)


def test_colmap_joins_the_photos_of_a_textured_object(tmp_path):
    pytest.importorskip("pycolmap")
    from tracking3d.testing.synthesis.convex_clips import make_demo_clip
    from tracking3d_bench.datasets.clip import read_truth

    truth = read_truth(make_demo_clip(tmp_path / "clip", frames=6, size=(320, 240)))
    found, seconds = peer.run_colmap(truth, range(0, 6, 2), lowered=True)
    row = peer.score_views("colmap", found, truth, None, seconds)
    assert row.views == 3 and row.within_10_deg == row.placed and seconds > 0
