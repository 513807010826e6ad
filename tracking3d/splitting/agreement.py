"""Whether two parts of a video, tracked without knowing of each other, tell of one object, and how it lies in both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.belief import Belief
from tracking3d.estimation.online.uniting import moved, same_landmarks
from tracking3d.geometry.camera import Camera
from tracking3d.results.records import FrameRecord
from tracking3d.splitting.map_joining import through_lens
from tracking3d.splitting.similarity import SimilarityFit, fit_similarity

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
    """Two parts cannot be joined; the text says why, as the end of a sentence."""


@dataclass(frozen=True, eq=False)
class Joint:
    """How the second of two parts lies in the first.

    Attributes:
        fit: Of their poses, and of landmarks where both know some.
        frames: How many were compared.
        landmarks: How many were.
    """

    fit: SimilarityFit
    frames: int
    landmarks: int


def common_poses(
    first: Sequence[FrameRecord], second: Sequence[FrameRecord]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses ``(F, 4, 4)`` of the frames that both have tracked; where those are too few, of all that neither lost."""
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
    """Make sure that two parts can be joined.

    Args:
        fit: Of their poses.
        radius: Of the first's object, in its unit.

    Raises:
        DisagreementError: If not.
    """
    similarity, frames = fit.similarity, len(fit.angles)
    if frames < FEWEST_FRAMES:
        raise DisagreementError(
            f"only {frames} frames of their overlap were tracked by both; {FEWEST_FRAMES} are needed"
        )
    # Where nothing moves, rounding decides whether the size is above 0.
    if not similarity.scale > 0 and fit.scale_error <= _MOST_SCALE_ERROR:
        raise DisagreementError("their overlap gives no size of one in that of the other")
    angle, wrong = float(np.median(fit.angles)), float(np.mean(fit.angles > _WRONG))
    if angle > MOST_DEGREES or wrong > _MOST_WRONG:
        raise DisagreementError(
            f"their rotations disagree, by {angle:.0f} degrees in the median of the overlap and by more than "
            f"{_WRONG:.0f} in {wrong:.0%} of it, as where an object looks alike from several sides"
        )
    distance = float(np.median(fit.distances)) / radius
    if distance > _MOST_DISTANCE:
        raise DisagreementError(f"they have the object in places {distance:.2f} of its radius apart")
    if fit.scale_error > _MOST_SCALE_ERROR or fit.translation_error > _MOST_TRANSLATION_ERROR * radius:
        raise DisagreementError(
            "the object hardly moves in their overlap, which leaves open how large one is beside the other"
        )


def joint_of(
    first: Belief, second: Belief, of_first: Sequence[FrameRecord], of_second: Sequence[FrameRecord]
) -> Joint:
    """How the second part lies in the first.

    Args:
        first: What the first part knows in the end.
        second: What the second does, by the first's camera.
        of_first: The first's answers.
        of_second: The second's, by the first's camera.

    Raises:
        DisagreementError: If they cannot be joined.
    """
    radius = first.known.radius
    T_first, T_second = common_poses(of_first, of_second)
    if len(T_first) < FEWEST_FRAMES:
        raise DisagreementError(
            f"only {len(T_first)} frames of their overlap were tracked by both; {FEWEST_FRAMES} are needed"
        )
    fit = fit_similarity(T_first, T_second)
    landmarks = 0
    if fit.similarity.scale > 0:
        there = moved(second.known, fit.similarity)
        pairs = same_landmarks(first.known, there, first.camera)
        x_first = first.known.landmarks[pairs[:, 0]]
        x_second = second.known.landmarks[pairs[:, 1]]
        sound = np.isfinite(x_first).all(1) & np.isfinite(x_second).all(1)
        landmarks = int(sound.sum())
        fit = fit_similarity(T_first, T_second, x_first[sound], x_second[sound])
    check_agreement(fit, radius)
    return Joint(fit, len(T_first), landmarks)


def by_lens(
    belief: Belief, records: Sequence[FrameRecord], camera: Camera
) -> tuple[Belief, list[FrameRecord]]:
    """A part's knowledge and answers as another lens would have them."""
    lens = (camera.fx, camera.fy, camera.cx, camera.cy)
    seen = []
    for record in records:
        T = record.T_cam_obj.copy()
        T[2, 3] *= camera.fy / record.through(belief.camera).fy
        seen.append(replace(record, T_cam_obj=T, camera=lens))
    return through_lens(belief, camera), seen
