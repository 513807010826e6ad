"""Motion leads on for a while after an object was lost: near where it goes, and not for long."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from rendered_solids import pose_of

from tracking3d.estimation.online.pose_tracking import is_consistent_with_motion, pose_predictions
from tracking3d.geometry.camera import Camera


def lost(frames: int, step: float = 5.0):
    """An object that turned by so many degrees a frame through frames 0 to 9, and has been lost since."""
    trail = tuple((pose_of(step * n, (0, 1, 0)), n) for n in range(10))
    camera = Camera.from_fov(80, 60)
    return SimpleNamespace(
        trajectory=trail,
        lost_frames=frames,
        last_pose=trail[-1],
        previous_pose=None,
        camera=camera,
        last_candidate=None,
        lost=frames > 0,
    )


@pytest.mark.parametrize("off", [-25.0, 0.0, 25.0])
def test_a_pose_near_where_the_motion_goes_is_led_to(off):
    assert is_consistent_with_motion(lost(3), pose_of(5.0 * 12 + off, (0, 1, 0)), 12)


def test_a_pose_elsewhere_is_not():
    assert not is_consistent_with_motion(lost(3), pose_of(5.0 * 12 + 40, (0, 1, 0)), 12)
    assert not is_consistent_with_motion(lost(3), pose_of(180.0, (0, 1, 0)), 12)


def test_a_long_loss_leads_nowhere():
    assert not is_consistent_with_motion(lost(20), pose_of(5.0 * 12, (0, 1, 0)), 29)


def test_without_any_motion_nothing_is_led_to():
    assert not is_consistent_with_motion(
        SimpleNamespace(trajectory=(), lost_frames=1, lost=True), pose_of(0), 1
    )


def test_a_lost_object_is_looked_for_where_it_goes_first():
    starts = pose_predictions(lost(3), 12, None)
    assert list(starts) == ["motion_model", "last"]
    turned = np.degrees(2 * np.arccos(abs(float(starts["motion_model"].quaternion[0]))))
    assert turned == pytest.approx(60, abs=1)


def test_a_mask_tells_where_a_lost_object_is_again():
    mask = np.zeros((60, 80), bool)
    mask[10:20, 60:70] = True
    state = lost(3)
    state.last_candidate = pose_of(200.0, (0, 1, 0))
    starts = pose_predictions(state, 12, mask)
    assert list(starts) == [
        "motion_model",
        "last",
        "motion_model in the mask",
        "last in the mask",
        "last_candidate",
    ]
    for name in ("motion_model in the mask", "last in the mask", "last_candidate"):
        x, y, z = starts[name].translation.tolist()
        K = state.camera.K
        assert (K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]) == pytest.approx((64.5, 14.5), abs=1e-3)
    assert torch.equal(starts["last_candidate"].quaternion, state.last_candidate.quaternion)
