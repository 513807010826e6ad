"""Where an object should be in the next frame, by how it has moved; and the belief as it moves on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief
from tracking3d.estimation.online.mapping import project_points
from tracking3d.estimation.online.tracking import coast, placed
from tracking3d.geometry.pose import Pose, extrapolate, rotation_angle

_BRIEF, _NEAR = 5, 30.0
"""Frames of a loss, and degrees, within which motion still tells a side that was never seen: a thin view of a card."""


def predicted(state: Belief, index: int, mask: NDArray[np.bool_] | None) -> dict[str, Pose]:
    """Poses to start from in frame ``index``, by name, the likeliest first.

    Args:
        state: Before the frame.
        index: Of the frame.
        mask: ``(H, W)`` its initial mask, or None: of an object that was lost it says where it is again.
    """
    last, last_index = state.last
    if state.lost_for and state.trail:
        starts = {"coasting": coast(state.trail, index), "last": state.trail[-1][0]}
        if mask is not None:
            starts |= {
                f"{name} in the mask": placed(pose, state.camera, mask) for name, pose in starts.items()
            }
            if state.tried is not None:
                starts["tried"] = placed(state.tried, state.camera, mask)
        return starts
    if state.before is None:
        return {"last": last}
    before, before_index = state.before
    steps = (index - last_index) / max(last_index - before_index, 1)
    return {"velocity": extrapolate(before, last, min(steps, 3.0)), "last": last}


def carried(state: Belief, pose: Pose) -> NDArray[np.float32] | None:
    """``(N, 2)`` pixels where the points that are followed should be at a pose; None where there are none."""
    if not len(state.followed):
        return None
    position = state.known.landmarks[state.followed.landmark]
    there, here = (project_points(position, one, state.camera) for one in (pose, state.last[0]))
    return np.asarray(state.followed.pixel + np.nan_to_num(there - here), dtype=np.float32)


def led_to(state: Belief, pose: Pose, index: int) -> bool:
    """Whether the motion from before a loss leads to a pose: only a while, and only near where it goes on."""
    if not state.trail or index - state.trail[-1][1] > _BRIEF + 1:
        return False
    away = float(rotation_angle(coast(state.trail, index).quaternion, pose.quaternion))
    return math.degrees(away) < _NEAR


def moved_on(state: Belief, found: Attempt, pose: Pose, grey: NDArray[np.uint8]) -> Belief:
    """The belief one frame later, with how long the object has been lost or hardly believed.

    Args:
        state: Before the frame.
        found: What was found in it.
        pose: That it is answered with.
        grey: ``(H, W)`` the frame.
    """
    searched_for = state.lost_for + 1 if found.view.mask is not None else max(state.lost_for, 1)
    return replace(
        state.moved(pose, found.view.index, grey, found.points),
        lost_for=found.lost * searched_for,
        doubted_for=found.doubtful * (state.doubted_for + 1),
        tried=found.fit.pose if found.lost and found.view.mask is not None else None,
    )
