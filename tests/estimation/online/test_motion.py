"""Motion leads on for a while after an object was lost: near where it goes, and not for long."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rendered_solids import pose_of

from tracking3d.estimation.online.motion import led_to, predicted


def lost(frames: int, step: float = 5.0):
    """An object that turned by so many degrees a frame through frames 0 to 9, and has been lost since."""
    trail = tuple((pose_of(step * n, (0, 1, 0)), n) for n in range(10))
    return SimpleNamespace(trail=trail, lost_for=frames, last=trail[-1], before=None)


@pytest.mark.parametrize("off", [-25.0, 0.0, 25.0])
def test_a_pose_near_where_the_motion_goes_is_led_to(off):
    assert led_to(lost(3), pose_of(5.0 * 12 + off, (0, 1, 0)), 12)


def test_a_pose_elsewhere_is_not():
    assert not led_to(lost(3), pose_of(5.0 * 12 + 40, (0, 1, 0)), 12)
    assert not led_to(lost(3), pose_of(180.0, (0, 1, 0)), 12)


def test_a_long_loss_leads_nowhere():
    assert not led_to(lost(20), pose_of(5.0 * 12, (0, 1, 0)), 29)


def test_without_any_motion_nothing_is_led_to():
    assert not led_to(SimpleNamespace(trail=(), lost_for=1), pose_of(0), 1)


def test_a_lost_object_is_looked_for_where_it_goes_first():
    starts = predicted(lost(3), 12)
    assert list(starts) == ["coasting", "last"]
    turned = np.degrees(2 * np.arccos(abs(float(starts["coasting"].quaternion[0]))))
    assert turned == pytest.approx(60, abs=1)
