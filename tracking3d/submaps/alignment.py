"""Alignment of two parts of a video that were tracked independently, and whether they agree on one object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.atlas.map_merging import match_landmarks, transform_map
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.geometry.camera import Camera
from tracking3d.results.records import FrameRecord
from tracking3d.submaps.similarity import SimilarityFit, fit_similarity
from tracking3d.submaps.state_merging import through_lens

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
    first: SolverState, second: SolverState, of_first: Sequence[FrameRecord], of_second: Sequence[FrameRecord]
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
    state: SolverState, records: Sequence[FrameRecord], camera: Camera
) -> tuple[SolverState, list[FrameRecord]]:
    """A part's map and estimates under another focal length."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    seen = []
    for record in records:
        T = record.T_cam_obj.copy()
        T[2, 3] *= camera.fy / record.through(state.camera).fy
        seen.append(replace(record, T_cam_obj=T, camera=lens))
    return through_lens(state, camera), seen
