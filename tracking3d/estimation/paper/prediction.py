"""Where a new frame's pose starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.paper.belief import PaperState
from tracking3d.geometry.pose import Pose, extrapolate
from tracking3d.rendering.visibility import NEAR


def candidate_poses(belief: PaperState, index: int, mask: NDArray[np.bool_] | None) -> list[Pose]:
    """The last pose, constant velocity, and their rotations moved to where the mask is.

    After a lost frame there is no velocity to go on with; the keyframes' poses are tried instead.
    """
    last, last_index = belief.last
    candidates = [last]
    if belief.before is not None:
        before, before_index = belief.before
        steps = (index - last_index) / max(last_index - before_index, 1)
        candidates.append(extrapolate(before, last, min(steps, 3.0)))
    else:
        candidates += [keyframe.pose for keyframe in belief.keyframes]
    if mask is not None and mask.any():
        candidates += [moved_to_mask(belief, pose, mask) for pose in list(candidates)]
    return candidates


def moved_to_mask(belief: PaperState, pose: Pose, mask: NDArray[np.bool_]) -> Pose:
    """Shift a pose so that its silhouette has the mask's centroid and area."""
    silhouette = belief.silhouette(pose)
    camera = belief.camera
    x1, y1 = _centroid(mask)
    if silhouette.any():
        x0, y0 = _centroid(silhouette)
        ratio = float(np.clip(np.sqrt(silhouette.sum() / mask.sum()), 0.8, 1.25))
    else:  # the pose has left the view: bring its centre back
        x, y, z = pose.translation.tolist()
        x0, y0 = camera.cx + camera.fx * x / max(z, NEAR), camera.cy + camera.fy * y / max(z, NEAR)
        ratio = 1.0
    depth = float(pose.translation[2])
    shift = pose.translation.new_tensor([(x1 - x0) / camera.fx * depth, (y1 - y0) / camera.fy * depth, 0.0])
    return Pose((pose.translation + shift) * ratio, pose.quaternion)


def _centroid(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.argwhere(mask)[:, ::-1].mean(0)
