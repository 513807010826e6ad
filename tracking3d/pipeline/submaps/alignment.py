"""Alignment of two parts of a video that were tracked independently, and whether they agree on one object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch.nn import functional

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.atlas import match_landmarks, merge, transform_map
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.focal_length import map_through_lens
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.geometry.alignment import rotation_alignment
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.similarity import Similarity
from tracking3d.results.records import FrameRecord

# The similarity between the objects of two runs over the same frames, by their poses and by points that both know.
#
# One camera cannot tell size from distance, so that the objects, and with them the cameras' distances, differ by a
# scale beside the rotation and the translation::
#
#     x_first = scale R x_second + translation
#     x_cam_first = scale x_cam_second
#
# Rotations of frames are averaged by their geodesic median. Given that, scale and translation are linear in what is
# known: a frame's two translations, and a surface point's two places (Umeyama 1991 of points alone). The least sum of
# distances is found by reweighting, so that a minority of wrong frames and points does not count.

Array = NDArray[np.float64]
_STEPS = 50
_CLOSE = 1e-9
_OUTLYING = 3.0  # times the median
_RIGHT = 2.0  # degrees that no frame is left out for
_FLOOR = 1e-3  # of the median distance, so that no single row takes all the weight


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity and its uncertainty."""

    similarity: Similarity  # the similarity
    angles: Array  # (F,) degrees by which it leaves each frame's rotation wrong
    distances: Array  # (F,) the same of translations, in the first's unit
    scale_error: float  # standard error of the scale, relative
    translation_error: float  # standard error of the translation, in the first's unit


def fit_similarity(
    T_cam_first: Array, T_cam_second: Array, x_first: Array | None = None, x_second: Array | None = None
) -> SimilarityFit:
    """Fit the similarity that explains two runs' poses of the same frames best.

    Args:
        T_cam_first: ``(F, 4, 4)`` poses of the first object.
        T_cam_second: ``(F, 4, 4)`` of the second, of the same frames.
        x_first: ``(N, 3)`` surface points of the first object; all of them together count as much as all frames.
        x_second: ``(N, 3)`` the same points on the second.

    Raises:
        ValueError: If there is no frame, or shapes differ.
    """
    if T_cam_first.shape != T_cam_second.shape or T_cam_first.ndim != 3 or not len(T_cam_first):
        raise ValueError(
            f"poses need equal shapes (F, 4, 4) with F > 0, got {T_cam_first.shape} and {T_cam_second.shape}"
        )
    R_first, R_second = T_cam_first[:, :3, :3], T_cam_second[:, :3, :3]
    t_first, t_second = T_cam_first[:, :3, 3], T_cam_second[:, :3, 3]
    R = rotation_alignment(R_first, R_second)
    angles = np.degrees(Rotation.from_matrix(np.swapaxes(R_first @ R, 1, 2) @ R_second).magnitude())
    # A frame whose rotation is wrong has a wrong translation too, and by it more say than others.
    sound = angles <= max(_OUTLYING * float(np.median(angles)), _RIGHT)
    rows = np.concatenate([R_first, -t_second[..., None]], axis=2)[sound]
    values, weight = -t_first[sound], np.full(len(rows), 1 / len(rows))
    if x_first is not None and x_second is not None and len(x_first):
        if x_first.shape != x_second.shape:
            raise ValueError(f"points need equal shapes (N, 3), got {x_first.shape} and {x_second.shape}")
        eye = np.broadcast_to(np.eye(3), (len(x_first), 3, 3))
        rows = np.concatenate([rows, np.concatenate([eye, (x_second @ R.T)[..., None]], axis=2)])
        values = np.concatenate([values, x_first])
        weight = np.concatenate([weight, np.full(len(x_first), 1 / len(x_first))])
    solution, spread = _least_distances(rows, values, weight)
    similarity = Similarity(R, float(solution[3]), solution[:3])
    moved = similarity.poses(T_cam_second)
    distances = np.linalg.norm(moved[:, :3, 3] - t_first, axis=1)
    scale_error = float(np.sqrt(spread[3, 3]) / max(abs(similarity.scale), 1e-12))
    return SimilarityFit(similarity, angles, distances, scale_error, float(np.sqrt(np.trace(spread[:3, :3]))))


def _least_distances(rows: Array, values: Array, weight: Array) -> tuple[Array, Array]:
    """``x`` ``(4,)`` with the least weighted sum of ``|rows_n x - values_n|``, and its covariance ``(4, 4)``.

    What the rows leave open is as short as it can be.
    """
    trust, x, normal = weight, np.zeros(4), np.eye(4)
    for _ in range(_STEPS):
        normal = np.einsum("n,nki,nkj->ij", trust, rows, rows)
        before, x = x, np.linalg.pinv(normal) @ np.einsum("n,nki,nk->i", trust, rows, values)
        distances = np.linalg.norm(rows @ x - values, axis=1)
        usual = float(np.median(distances))
        trust = weight / np.maximum(distances, max(_FLOOR * usual, 1e-12))
        if np.abs(x - before).max() <= _CLOSE * max(float(np.abs(x).max()), 1e-12):
            break
    # As least squares with the final weights: how far the rows' scatter lets the solution move.
    trust = trust / trust.sum()
    normal = np.einsum("n,nki,nkj->ij", trust, rows, rows)
    freedom = max(3 * len(rows) - 4, 1)
    scatter = float(np.sum(trust[:, None] * (rows @ x - values) ** 2)) / freedom * len(rows)
    inverse = np.linalg.pinv(normal, rcond=1e-10)
    return x, scatter * inverse / max(len(rows), 1) + _open(normal)


def _open(normal: Array) -> Array:
    """A covariance without end in the directions that the rows leave open."""
    values, directions = np.linalg.eigh(normal)
    free = directions[:, values < 1e-10 * max(float(values.max()), 1e-300)]
    return np.asarray(1e6 * free @ free.T)


FEWEST_FRAMES = 5
"""Frames that both parts have tracked."""
MOST_DEGREES = 8.0
"""Median angle between the parts' rotations; an object that looks alike from several sides exceeds it."""
_WRONG = 20.0  # degrees
_MOST_WRONG = 0.34  # share of the frames
_MOST_DISTANCE = 0.25  # median, in radii of the object
_MOST_SCALE_ERROR = 0.1
_MOST_TRANSLATION_ERROR = 0.5  # in radii


class DisagreementError(Exception):
    """Two parts cannot be merged; the text says why, as the end of a sentence."""


@dataclass(frozen=True, eq=False)
class SubmapAlignment:
    """The similarity from the second of two parts to the first."""

    fit: SimilarityFit  # similarity of their poses, and of landmarks if both have some
    frames: int  # number of compared frames
    landmarks: int  # number of compared landmarks


def common_poses(
    first: Sequence[FrameRecord], second: Sequence[FrameRecord]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses ``(F, 4, 4)`` of the frames that both have tracked; if those are too few, of all that neither lost."""
    for trusted in (_is_tracked, _is_there):
        own = {one.index: one.T_cam_obj for one in first if trusted(one)}
        other = {one.index: one.T_cam_obj for one in second if trusted(one)}
        common = sorted(own.keys() & other.keys())
        if len(common) >= FEWEST_FRAMES:
            break
    if not common:
        return np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
    return np.stack([own[index] for index in common]), np.stack([other[index] for index in common])


def _is_tracked(record: FrameRecord) -> bool:
    return record.status is Status.TRACKED and _is_there(record)


def _is_there(record: FrameRecord) -> bool:
    return record.status is not Status.LOST and bool(np.isfinite(record.T_cam_obj).all())


def check_agreement(fit: SimilarityFit, radius: float) -> None:
    """Make sure that two parts can be merged.

    Args:
        fit: Similarity of their poses.
        radius: Radius of the first's object, in its unit.

    Raises:
        DisagreementError: If not.
    """
    similarity, frames = fit.similarity, len(fit.angles)
    if frames < FEWEST_FRAMES:
        raise DisagreementError(
            f"only {frames} frames of their overlap were tracked by both; {FEWEST_FRAMES} are needed"
        )
    # If nothing moves, rounding decides whether the size is above 0.
    if not similarity.scale > 0 and fit.scale_error <= _MOST_SCALE_ERROR:
        raise DisagreementError("their overlap does not determine the scale between them")
    angle, wrong = float(np.median(fit.angles)), float(np.mean(fit.angles > _WRONG))
    if angle > MOST_DEGREES or wrong > _MOST_WRONG:
        raise DisagreementError(
            f"their rotations disagree, by {angle:.0f} degrees in the median of the overlap and by more than "
            f"{_WRONG:.0f} in {wrong:.0%} of it, as for an object that looks alike from several sides"
        )
    distance = float(np.median(fit.distances)) / radius
    if distance > _MOST_DISTANCE:
        raise DisagreementError(f"they have the object in places {distance:.2f} of its radius apart")
    if fit.scale_error > _MOST_SCALE_ERROR or fit.translation_error > _MOST_TRANSLATION_ERROR * radius:
        raise DisagreementError(
            "the object hardly moves in their overlap, which leaves the scale between them open"
        )


def align_submaps(
    first: Mapped, second: Mapped, of_first: Sequence[FrameRecord], of_second: Sequence[FrameRecord]
) -> SubmapAlignment:
    """The similarity from the second part to the first.

    Args:
        first: What the first part knows in the end.
        second: What the second does, by the first's camera.
        of_first: The first's estimates.
        of_second: The second's, by the first's camera.

    Raises:
        DisagreementError: If they cannot be merged.
    """
    radius = first.object_map.radius
    T_first, T_second = common_poses(of_first, of_second)
    if len(T_first) < FEWEST_FRAMES:
        raise DisagreementError(
            f"only {len(T_first)} frames of their overlap were tracked by both; {FEWEST_FRAMES} are needed"
        )
    fit = fit_similarity(T_first, T_second)
    landmarks = 0
    if fit.similarity.scale > 0:
        there = transform_map(second.object_map, fit.similarity)
        pairs = match_landmarks(first.object_map, there, first.camera)
        x_first = first.object_map.landmarks[pairs[:, 0]]
        x_second = second.object_map.landmarks[pairs[:, 1]]
        sound = np.isfinite(x_first).all(1) & np.isfinite(x_second).all(1)
        landmarks = int(sound.sum())
        fit = fit_similarity(T_first, T_second, x_first[sound], x_second[sound])
    check_agreement(fit, radius)
    return SubmapAlignment(fit, len(T_first), landmarks)


def by_lens(
    state: Mapped, records: Sequence[FrameRecord], camera: Camera
) -> tuple[Mapped, list[FrameRecord]]:
    """A part's map and estimates under another focal length."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    seen = []
    for record in records:
        T = record.T_cam_obj.copy()
        T[2, 3] *= camera.fy / record.through(state.camera).fy
        seen.append(replace(record, T_cam_obj=T, camera=lens))
    return through_lens(state, camera), seen


def through_lens(state: Mapped, camera: Camera) -> Mapped:
    """The state under another focal length: depths scale with it, the object's size stays."""
    before = state.camera
    if camera == before:
        return state
    return replace(state, camera=camera, object_map=map_through_lens(state.object_map, before, camera))


def reproject_features(
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


def merge_states(states: Sequence[Mapped], similarities: Sequence[Similarity], config: OnlineConfig,
           encoder: FeatureEncoder) -> Mapped:  # fmt: skip
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
        second = reproject_features(
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
