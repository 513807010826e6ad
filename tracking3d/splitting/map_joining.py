"""What several parts of a video know as one belief: of one lens, in one space of features, refined together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn import functional

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.belief import Belief, ObjectMap
from tracking3d.estimation.online.growing import refined
from tracking3d.estimation.online.lens import through
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.uniting import moved, same_landmarks, united
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.similarity import Similarity


def through_lens(belief: Belief, camera: Camera) -> Belief:
    """A belief as another lens would have it: depths go with the focal length, the object's size stays."""
    before = belief.camera
    if camera == before:
        return belief
    keyframes = tuple(through(view, before, camera) for view in belief.known.keyframes)
    return replace(belief, camera=camera, known=replace(belief.known, keyframes=keyframes))


def in_space(
    known: ObjectMap, own: FeatureSpace | None, space: FeatureSpace | None, encoder: FeatureEncoder
) -> ObjectMap:
    """A map whose features are of its ``own`` space, with those of another map's: turned, or encoded once more.

    Where a space keeps all channels nothing was lost, and what is exact is also cheaper.
    """

    def encoded(observation: Observation) -> Observation:
        if own is not None and space is not None and own.components.shape[0] == own.components.shape[1]:
            flat = observation.features.flatten(1)
            whole = torch.linalg.solve(own.components, flat).view_as(observation.features)
            return replace(observation, features=space.project(whole + own.mean[:, None, None]))
        size = (observation.window.size,) * 2
        image = functional.interpolate(observation.image[None], size=size, mode="bilinear", antialias=True)
        features = encoder.encode(image if encoder.stride == 1 else observation.image[None])
        if features.shape[-1] != size[0]:
            features = functional.interpolate(features, size=size, mode="bilinear", antialias=True)
        features = features[0].float()
        return replace(observation, features=features if space is None else space.project(features))

    keyframes = tuple(
        replace(view, observation=encoded(view.observation), texture=None) for view in known.keyframes
    )
    return replace(known, keyframes=keyframes)


def merge_states(beliefs: Sequence[Belief], similarities: Sequence[Similarity], config: OnlineConfig,
           encoder: FeatureEncoder) -> Belief:  # fmt: skip
    """What several parts know as one belief, poses, landmarks and shape refined together.

    Args:
        beliefs: Of the parts, each of one camera, see `through_lens`, and each past its start.
        similarities: From each part's object to the first one's.
        config: Of the solver.
        encoder: Of the features.
    """
    first, camera = beliefs[0], beliefs[0].camera
    known = first.known
    for belief, similarity in zip(beliefs[1:], similarities[1:], strict=True):
        second = in_space(moved(belief.known, similarity), belief.space, first.space, encoder)
        pairs = same_landmarks(known, second, camera)
        most = max(config.most_keyframes, len(known.keyframes))
        known = united(known, second, pairs, most)
    everything = list(range(len(known.keyframes)))
    known = refined(known, camera, everything, config, bundle_iterations=20, rounds=3)
    return replace(
        first,
        known=known,
        surface=known.surface(),
        anew=None,
        aside=(),
        before=None,
        lost_for=0,
        doubted_for=0,
        followed=FollowedPoints.none(),
    )
