"""What several parts of a video know as one belief: of one lens, in one space of features, refined together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn import functional

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.atlas.map_merging import match_landmarks, merge, transform_map
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.focal_length import map_through_lens
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.similarity import Similarity


def through_lens(state: SolverState, camera: Camera) -> SolverState:
    """The state under another focal length: depths scale with it, the object's size stays."""
    before = state.camera
    if camera == before:
        return state
    return replace(state, camera=camera, object_map=map_through_lens(state.object_map, before, camera))


def in_space(
    object_map: ObjectMap, own: FeatureSpace | None, space: FeatureSpace | None, encoder: FeatureEncoder
) -> ObjectMap:
    """A map whose features are of its ``own`` space, with those of another map's: turned, or encoded once more.

    If a feature space keeps all channels, nothing was lost, and the exact way is also cheaper.
    """

    def encoded(observation: Observation) -> Observation:
        if own is not None and space is not None and own.components.shape[0] == own.components.shape[1]:
            kept = observation.features[: len(own.components)]
            whole = torch.linalg.solve(own.components, kept.flatten(1)).view_as(kept)
            return replace(
                observation, features=space.project(whole + own.mean[:, None, None], observation.image)
            )
        size = (observation.window.size,) * 2
        image = functional.interpolate(observation.image[None], size=size, mode="bilinear", antialias=True)
        features = encoder.encode(image if encoder.stride == 1 else observation.image[None])
        if features.shape[-1] != size[0]:
            features = functional.interpolate(features, size=size, mode="bilinear", antialias=True)
        features = features[0].float()
        return replace(
            observation, features=features if space is None else space.project(features, observation.image)
        )

    keyframes = tuple(
        replace(view, observation=encoded(view.observation), texture=None) for view in object_map.keyframes
    )
    return replace(object_map, keyframes=keyframes)


def merge_states(states: Sequence[SolverState], similarities: Sequence[Similarity], config: OnlineConfig,
           encoder: FeatureEncoder) -> SolverState:  # fmt: skip
    """What several parts know as one belief, poses, landmarks and shape refined together.

    Args:
        states: States of the parts, each of one camera, see `through_lens`, and each initialized.
        similarities: From each part's object to the first one's.
        config: The solver's configuration.
        encoder: The feature encoder.
    """
    first, camera = states[0], states[0].camera
    object_map = first.object_map
    for state, similarity in zip(states[1:], similarities[1:], strict=True):
        second = in_space(
            transform_map(state.object_map, similarity), state.feature_space, first.feature_space, encoder
        )
        pairs = match_landmarks(object_map, second, camera)
        most = max(config.max_keyframes, len(object_map.keyframes))
        object_map = merge(object_map, second, pairs, most)
    everything = list(range(len(object_map.keyframes)))
    object_map = refine_local_map(object_map, camera, everything, config, bundle_iterations=20, rounds=3)
    return replace(
        first,
        object_map=object_map,
        surface=object_map.surface(),
        reinitialization=None,
        inactive_maps=(),
        previous_pose=None,
        lost_frames=0,
        doubtful_frames=0,
        tracked_points=FollowedPoints.none(),
    )
