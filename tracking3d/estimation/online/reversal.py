"""The map with depth the other way round, where its keyframes are explained better so.

The start chooses between the two; where little turning tells them apart it can be the wrong one. See
`tracking3d.bundle_adjustment.reversal`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tracking3d.bundle_adjustment.adjustment import Structure, adjust
from tracking3d.bundle_adjustment.reversal import Reversal, reversal_of
from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online.belief import Belief, ObjectMap
from tracking3d.estimation.online.growing import refined
from tracking3d.estimation.online.mapping import (
    pose_of,
    shared_landmarks,
    structure_of,
    tracks_of,
    viewing_angle,
)
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose

_FEWEST_LANDMARKS = 12
_FEWEST_KEYFRAMES = 4
_BETTER = 0.97
"""Share of the cost up to which the other way round is the better one. In runs that were right it was 1.02 and more at
each of some 200 keyframes (suites ``fresh`` of seeds 501, 602 and 9303), in wrong ones .81 to 1.04."""
_MOST_TURNED = 100.0  # degrees; what has shown more of its sides cannot be the other way round
_ALWAYS_TRIED = 12
"""Keyframes up to which it is tried at each. Later, when there are this many more, or have turned by so much more:
trying costs as much as bundling all keyframes, and keyframes that show the same again tell nothing new."""
_MORE_KEYFRAMES, _MORE_TURNED = 1.25, 4.0
_ITERATIONS = 20
_HELD = 0.05  # what a landmark at distance 1 from its place costs: the wrong way round has bent the surface
_SCALE = 1.0  # pixels


def turned_round(belief: Belief, config: OnlineConfig) -> Belief:
    """The belief with depth the other way round where that explains the keyframes better, else as it is."""
    known, views = belief.known, belief.known.keyframes
    if known.held or known.pointless or len(views) < _FEWEST_KEYFRAMES:
        return belief
    turned = max(viewing_angle(views[0].pose, view.pose) for view in views)
    if turned > _MOST_TURNED or not _due(belief.reversal_tried, len(views), turned):
        return belief
    better = _better_reversed(known, belief.camera)
    if better is None:
        return replace(belief, reversal_tried=(len(views), turned))
    reversal, known = better
    everything = list(range(len(known.keyframes)))
    known = refined(known, belief.camera, everything, config, bundle_iterations=20, rounds=2)
    before = belief.before and (_reversed(belief.before[0], reversal), belief.before[1])
    trail = tuple((_reversed(pose, reversal), index) for pose, index in belief.trail)
    last = known.keyframes[-1].pose, belief.last[1]
    return replace(
        belief, known=known, surface=known.surface(), last=last, before=before, trail=trail, past=(),
        reversal_tried=(0, 0.0),
    )  # fmt: skip


def _due(tried: tuple[int, float], keyframes: int, turned: float) -> bool:
    """Whether enough is new since it was tried last."""
    return (
        keyframes <= _ALWAYS_TRIED
        or keyframes >= _MORE_KEYFRAMES * tried[0]
        or turned >= tried[1] + _MORE_TURNED
    )


def _better_reversed(known: ObjectMap, camera: Camera) -> tuple[Reversal, ObjectMap] | None:
    """The reversal and the map that it makes, where that explains the keyframes better."""
    views = list(known.keyframes)
    names = shared_landmarks(known, views)
    names = names[np.isfinite(known.landmarks[names]).all(1)]
    if len(names) < _FEWEST_LANDMARKS:
        return None
    tracks, start = tracks_of(views, names), structure_of(known, views, names)
    T = np.stack([view.pose.matrix().numpy() for view in views])
    # The first keyframe's pose never moves.
    reversal = reversal_of(start.points, T[0])
    T = reversal.poses(T)
    other = Structure(T[:, :3, :3], T[:, :3, 3], reversal.points(start.points))
    as_it_is, found = (
        adjust(
            tracks, camera.K, one, fixed=1, scale=_SCALE, iterations=_ITERATIONS,
            point_prior=one.points, point_prior_weight=_HELD,
        )
        for one in (start, other)
    )  # fmt: skip
    if found.cost > _BETTER * as_it_is.cost:
        return None
    landmarks = reversal.points(known.landmarks)
    landmarks[names] = found.points
    vertices = known.vertices.double().cpu().numpy()
    surface = torch.from_numpy(reversal.surface(vertices, start.points, found.points)).to(known.vertices)
    poses = (pose_of(R, t, known.vertices) for R, t in zip(found.R, found.t, strict=True))
    keyframes = tuple(replace(view, pose=pose, texture=None) for view, pose in zip(views, poses, strict=True))
    return reversal, replace(known, vertices=surface, landmarks=landmarks, keyframes=keyframes)


def _reversed(pose: Pose, reversal: Reversal) -> Pose:
    T = reversal.poses(pose.matrix().numpy())
    return pose_of(T[:3, :3], T[:3, 3], pose.translation)
