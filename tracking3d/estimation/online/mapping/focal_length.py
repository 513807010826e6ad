"""The focal length if it is not given: hypotheses for the initialization, later estimated with poses and points.

A wrong focal length makes the object rotate too little or too much. Several are tried, since the cost has a local
minimum near each; the current one stays unless another explains the points clearly better.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from tracking3d.estimation.online.mapping.local_mapping import shared_landmarks, structure_of, tracks_of
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, Mapped
from tracking3d.geometry.camera import OUTERMOST_LENSES, Camera
from tracking3d.geometry.pose import Pose, pose_from_arrays
from tracking3d.points.bundle_adjustment.adjustment import Structure, adjust

CANDIDATES = (10.0, 25.0, 45.0, 65.0)
"""Vertical fields of view in degrees."""
_INITIAL_FIELDS_OF_VIEW = (OUTERMOST_LENSES[0], 16.0, 27.0, 65.0)  # besides the assumed one
_MIN_GAIN = 0.08  # relative gain required of twice or half the focal length; less for nearer ones
_SAME_FOCAL_LENGTH = math.log(1.05)  # focal lengths within this ratio are the same
_ITERATIONS = 25
_MIN_LANDMARKS = 30  # landmarks


def lens_hypotheses(camera: Camera) -> tuple[Camera, ...]:
    """The cameras of the initialization, the assumed one first; only that one if the focal length is given."""
    if not camera.assumed:
        return (camera,)
    others = [
        camera.zoom(
            Camera.from_fov(camera.width, camera.height, degrees).fy / camera.fy,
            f"field of view of {degrees:g} degrees, the likeliest of those tried",
        )
        for degrees in _INITIAL_FIELDS_OF_VIEW
    ]
    return (camera, *others)


def with_focal_length(view: Keyframe, before: Camera, after: Camera) -> Keyframe:
    """A view as seen with another focal length: the image stays, the depth scales with the focal length."""
    factor = after.fy / before.fy
    K = view.observation.K.clone()
    K[0, 0], K[1, 1] = factor * K[0, 0], factor * K[1, 1]
    pose = pose_through_lens(view.pose, factor)
    observation = replace(view.observation, K=K)
    return replace(view, pose=pose, observation=observation, texture=None, is_adjusted=False)


def pose_through_lens(pose: Pose, factor: float) -> Pose:
    """A pose as seen with a focal length ``factor`` times as long: the image stays, the depth scales."""
    x, y, z = pose.translation.unbind(-1)
    return Pose(torch.stack([x, y, factor * z], -1), pose.quaternion)


def map_through_lens(object_map: ObjectMap, before: Camera, after: Camera) -> ObjectMap:
    """A map as seen with another focal length: depths scale with it, the object keeps its size."""
    keyframes = tuple(with_focal_length(view, before, after) for view in object_map.keyframes)
    return replace(object_map, keyframes=keyframes)


def inactive_map_through_lens(other: InactiveMap, before: Camera, after: Camera) -> InactiveMap:
    """An inactive map as seen with another focal length."""
    if after == before:
        return other
    return replace(other, object_map=map_through_lens(other.object_map, before, after))


def state_through_lens(state: Mapped, after: Camera) -> Mapped:
    """The state with its maps and poses as seen with another focal length."""
    before = state.camera
    factor = after.fy / before.fy
    if factor == 1:
        return state
    return state.moved(
        map_through_lens(state.object_map, before, after),
        lambda pose: pose_through_lens(pose, factor),
        camera=after,
        inactive_maps=tuple(inactive_map_through_lens(other, before, after) for other in state.inactive_maps),
    )


def lens_change(factor: float) -> float:
    """How far two focal lengths are apart, in [0, 1]: 1 is a factor of two or more."""
    return min(abs(math.log2(factor)), 1.0)


def solve_lens(object_map: ObjectMap, camera: Camera) -> tuple[ObjectMap, Camera]:
    """The map and the camera with the focal length that explains the landmarks best.

    Args:
        object_map: The map.
        camera: The camera of the full frame, with the assumed focal length.
    """
    views = list(object_map.keyframes)
    names = shared_landmarks(object_map, views)
    if len(names) < _MIN_LANDMARKS:
        return object_map, camera
    tracks, start = tracks_of(views, names), structure_of(object_map, views, names)
    kept = adjust(tracks, camera.K, start, iterations=_ITERATIONS)
    tried = []
    candidates = [Camera.from_fov(camera.width, camera.height, angle).fy for angle in CANDIDATES]
    for lens in (1.0, *(focal / camera.fy for focal in candidates)):
        stretched = replace(start, t=start.t * [1.0, 1.0, lens], focal_factor=lens)
        tried.append(adjust(tracks, camera.K, stretched, iterations=_ITERATIONS, free_focal=True))
    tried = [one for one in tried if camera.may_have(one.focal_factor)]
    best = min(tried, key=lambda one: one.cost, default=kept)
    change = lens_change(best.focal_factor)
    if (
        abs(math.log(best.focal_factor)) < _SAME_FOCAL_LENGTH
        or best.cost > (1 - _MIN_GAIN * change) * kept.cost
    ):
        return object_map, camera
    return _with_lens(object_map, camera, names, best)


def _with_lens(
    object_map: ObjectMap, camera: Camera, names: np.ndarray, found: Structure
) -> tuple[ObjectMap, Camera]:
    factor = found.focal_factor
    landmarks = object_map.landmarks.copy()
    sound = np.isfinite(found.points).all(1)
    landmarks[names[sound]] = found.points[sound]
    solved = camera.with_solved_focal(factor)
    keyframes = [
        replace(
            with_focal_length(view, camera, solved),
            pose=pose_from_arrays(found.R[n], found.t[n], object_map.vertices),
        )
        for n, view in enumerate(object_map.keyframes)
    ]
    return replace(object_map, landmarks=landmarks, keyframes=tuple(keyframes)), solved
