"""Scores of poses: rotations and translations, up to the ambiguities of a single camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.alignment import ObjectAlignment, align_object_frame
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation import axis_symmetry
from tracking3d_bench.evaluation.alignment import translation_errors
from tracking3d_bench.evaluation.metrics import (
    aligned_rotation_errors,
    anchored_rotation_errors,
    consecutive_rotation_errors,
    share_under,
)

NO_ESTIMATE = 180.0
"""Rotation error in degrees of a frame without an estimate."""

CURVE_END = 20.0
"""Rotation error in degrees up to which the curve of `PoseScores.rotation_auc_20_deg` runs."""

AWAY, BACK = 45.0, 5.0
"""A clip returns to its first view if its last one is within `BACK` degrees of it, after one beyond `AWAY`."""

GOOD_TRANSLATION = 5.0
"""A frame's translation counts as right below so many percent of the object's distance."""


@dataclass(frozen=True, kw_only=True)
class PoseScores:
    """Poses over the frames with a trusted pose; see `tracking3d_bench.evaluation.metrics` and `...alignment`.

    All are None if there is no such frame; those of rotations, or of translations, also where a truth knows only
    the others. Every one of these frames counts in all figures of rotations: one that
    was called lost with the error of its pose, and as not right for the shares; one without a pose with 180 degrees.
    Turns about an axis of symmetry do not count, see `tracking3d_bench.evaluation.axis_symmetry`.

    Attributes:
        rotation_error_mean_deg, rotation_error_median_deg, rotation_error_max_deg: Aligned by one rotation.
        rotation_error_anchored_median_deg: Anchored at the first of these frames that has an estimate.
        rotation_error_consecutive_median_deg: From each to the next, if both have an estimate.
        rotation_error_return_deg: Error of the turn from the first to the last of the frames, in a clip that ends with
            the view that it began with and was 45 degrees away from it in between; None in others.
        axis_tilt_mean_deg, axis_tilt_max_deg: Angle between the axis of symmetry and the axis about which the method
            says that rotation is not known, over the frames that name one; None without either.
        share_axis_named: Share of the frames that name one, right or wrong.
        share_under_5_deg: Share with an aligned error under 5 degrees; a lost frame counts as not.
        rotation_auc_20_deg: The same share for a limit from 0 to 20 degrees, averaged over the limit.
        translation_error_mean_percent, translation_error_median_percent: Aligned by one similarity, in percent of
            the median true distance, over the frames that have an estimate.
        translation_share_under_5_percent: Share with an aligned error under 5 percent of that; a frame that is lost
            or has no estimate counts as not.
        frames_with_pose: Number of these frames.
    """

    rotation_error_mean_deg: float | None = None
    rotation_error_median_deg: float | None = None
    rotation_error_max_deg: float | None = None
    rotation_error_anchored_median_deg: float | None = None
    rotation_error_consecutive_median_deg: float | None = None
    rotation_error_return_deg: float | None = None
    share_under_5_deg: float | None = None
    rotation_auc_20_deg: float | None = None
    translation_error_mean_percent: float | None = None
    translation_error_median_percent: float | None = None
    translation_share_under_5_percent: float | None = None
    frames_with_pose: int = 0
    axis_tilt_mean_deg: float | None = None
    axis_tilt_max_deg: float | None = None
    share_axis_named: float | None = None


@dataclass(frozen=True, eq=False)
class PosePairs:
    """The frames whose true pose is known, and the estimates among them.

    Attributes:
        frames: All of them that were asked for.
        found: ``(M,)`` positions in `frames` of those that have an estimate.
        T_est, T_true: ``(M, 4, 4)`` of these.
        all_true: ``(N, 4, 4)`` true poses of all `frames`, NaN where a rotation or a translation is not known.
        axis: ``(3,)`` axis of symmetry in true object coordinates; None without one.
    """

    frames: list[int]
    found: NDArray[np.int64]
    T_est: NDArray[np.float64]
    T_true: NDArray[np.float64]
    all_true: NDArray[np.float64]
    axis: NDArray[np.float64] | None = None

    @property
    def with_rotation(self) -> PosePairs:
        """Those whose true rotation is known."""
        known = np.asarray(np.isfinite(self.all_true[:, :3, :3]).all((1, 2)), dtype=np.bool_)
        return self._where(known)

    @property
    def with_position(self) -> PosePairs:
        """Those whose true position is known; nothing that is seen lies in the camera's centre."""
        t = self.all_true[:, :3, 3]
        known = np.asarray(np.isfinite(t).all(1) & t.any(1), dtype=np.bool_)
        return self._where(known)

    def _where(self, known: NDArray[np.bool_]) -> PosePairs:
        kept = known[self.found]
        return replace(
            self,
            frames=[self.frames[place] for place in np.flatnonzero(known)],
            found=(np.cumsum(known) - 1)[self.found[kept]],
            T_est=self.T_est[kept],
            T_true=self.T_true[kept],
            all_true=self.all_true[known],
        )


def pair_poses(answers: Answers, truth: Truth) -> PosePairs | None:
    """Estimated and true poses; None if the method gives no poses or none is known."""
    frames = [n for n in answers.asked if n in truth.T_cam_obj]
    poses = answers.T_cam_obj
    if not frames or poses is None:
        return None
    found = [place for place, n in enumerate(frames) if n in poses]
    pairs = [(poses[frames[place]], truth.T_cam_obj[frames[place]]) for place in found]
    T_est, T_true = np.array(pairs).reshape(-1, 2, 4, 4).transpose(1, 0, 2, 3)
    all_true = np.array([truth.T_cam_obj[n] for n in frames])
    return PosePairs(frames, np.array(found, dtype=np.int64), T_est, T_true, all_true, truth.symmetry_axis)


def fit_alignment(pairs: PosePairs | None, diameter: float | None) -> ObjectAlignment | None:
    """The similarity between the two object frames over all frames whose pose is wholly known; None without estimates.

    Args:
        pairs: The poses.
        diameter: Diameter of the object in the truth's unit, if known.
    """
    whole = pairs and pairs.with_rotation.with_position
    if whole is None or not len(whole.found):
        return None
    return align_object_frame(whole.T_est, whole.T_true, diameter)


def rotation_errors(pairs: PosePairs) -> dict[int, float]:
    """Aligned error in degrees of each frame whose true rotation is known; 180 if there is no estimate."""
    pairs = pairs.with_rotation
    return dict(zip(pairs.frames, _align(pairs).tolist(), strict=True))


def _align(pairs: PosePairs) -> NDArray[np.float64]:
    errors = np.full(len(pairs.frames), NO_ESTIMATE)
    if len(pairs.found):
        R_est, R_true = pairs.T_est[:, :3, :3], pairs.T_true[:, :3, :3]
        errors[pairs.found] = (
            aligned_rotation_errors(R_est, R_true)
            if pairs.axis is None
            else axis_symmetry.aligned_axis_errors(R_est, R_true, pairs.axis)
        )
    return errors


def return_error(pairs: PosePairs) -> float | None:
    """Error in degrees of the turn from the first frame to the last; None if the last view is not the first again.

    180 if either has no estimate.
    """
    R = pairs.all_true[:, :3, :3]
    away = _anchor(np.broadcast_to(np.eye(3), R.shape), R, pairs.axis)
    if not (away.max() > AWAY and away[-1] < BACK):
        return None
    if not {0, len(pairs.frames) - 1} <= set(pairs.found.tolist()):
        return NO_ESTIMATE
    ends = [[0, -1]]
    R_est, R_true = pairs.T_est[ends][0, :, :3, :3], pairs.T_true[ends][0, :, :3, :3]
    return float(_anchor(R_est, R_true, pairs.axis)[-1])


def _anchor(
    R_est: NDArray[np.float64], R_true: NDArray[np.float64], axis: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    if axis is None:
        return anchored_rotation_errors(R_est, R_true)
    return axis_symmetry.anchored_axis_errors(R_est, R_true, axis)


def _consecutive(
    R_est: NDArray[np.float64], R_true: NDArray[np.float64], axis: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    if axis is None:
        return consecutive_rotation_errors(R_est, R_true)
    return axis_symmetry.consecutive_axis_errors(R_est, R_true, axis)


def score_poses(answers: Answers, pairs: PosePairs | None, alignment: ObjectAlignment | None) -> PoseScores:
    """Score the poses of all frames that were asked for and whose true pose, or a part of it, is known."""
    if pairs is None:
        return PoseScores()
    turned = _score_rotations(answers, pairs.with_rotation)
    moved = _score_translations(answers, pairs.with_position, alignment)
    named = _score_axis(answers, pairs.with_rotation)
    return PoseScores(**turned, **moved, **named, frames_with_pose=len(pairs.frames))


def _score_axis(answers: Answers, pairs: PosePairs) -> dict[str, float | None]:
    if not pairs.frames:
        return {}
    indices = [pairs.frames[place] for place in pairs.found]
    named = [place for place, index in enumerate(indices) if index in answers.free_axes]
    share = {"share_axis_named": len(named) / len(pairs.frames)}
    if pairs.axis is None or not named:
        return {**share}
    axes = np.array([answers.free_axes[indices[place]] for place in named])
    tilts = axis_symmetry.tilts(pairs.T_est[named, :3, :3], axes, pairs.T_true[named, :3, :3], pairs.axis)
    return {**share, "axis_tilt_mean_deg": float(tilts.mean()), "axis_tilt_max_deg": float(tilts.max())}


def _score_rotations(answers: Answers, pairs: PosePairs) -> dict[str, float | None]:
    if not pairs.frames:
        return {}
    aligned = _align(pairs)
    anchored = np.full(len(pairs.frames), NO_ESTIMATE)
    consecutive = np.empty(0)
    R_est, R_true = pairs.T_est[:, :3, :3], pairs.T_true[:, :3, :3]
    if len(pairs.found):
        anchored[pairs.found] = _anchor(R_est, R_true, pairs.axis)
    if len(pairs.found) > 1:
        consecutive = _consecutive(R_est, R_true, pairs.axis)[np.diff(pairs.found) == 1]
    tracked = _is_tracked(answers, pairs)
    return {
        "rotation_error_mean_deg": float(aligned.mean()),
        "rotation_error_median_deg": float(np.median(aligned)),
        "rotation_error_max_deg": float(aligned.max()),
        "rotation_error_anchored_median_deg": float(np.median(anchored)),
        "rotation_error_consecutive_median_deg": float(np.median(consecutive)) if len(consecutive) else None,
        "rotation_error_return_deg": return_error(pairs),
        "share_under_5_deg": share_under(np.where(tracked, aligned, NO_ESTIMATE)),
        "rotation_auc_20_deg": float(np.mean((1 - aligned / CURVE_END).clip(0) * tracked)),
    }


def _score_translations(
    answers: Answers, pairs: PosePairs, alignment: ObjectAlignment | None
) -> dict[str, float | None]:
    # Errors are measured in depths, which nothing has that lies behind the camera.
    if not pairs.frames or np.median(pairs.all_true[:, 2, 3]) <= 0:
        return {}
    moved = np.full(len(pairs.frames), np.inf)
    if len(pairs.found):
        T_true = pairs.T_true.copy()
        T_true[:, :3, :3] = np.nan_to_num(
            T_true[:, :3, :3]
        )  # translations are aligned without true rotations
        moved[pairs.found] = 100 * translation_errors(pairs.T_est, T_true, alignment or _of_positions(pairs))
    known = moved[np.isfinite(moved)]
    return {
        "translation_error_mean_percent": float(known.mean()) if len(known) else None,
        "translation_error_median_percent": float(np.median(known)) if len(known) else None,
        "translation_share_under_5_percent": float(
            np.mean(_is_tracked(answers, pairs) & (moved < GOOD_TRANSLATION))
        ),
    }


def _of_positions(pairs: PosePairs) -> ObjectAlignment:
    """Scale and offset if no true rotation is known; the rotation means nothing."""
    T_true = pairs.T_true.copy()
    T_true[:, :3, :3] = pairs.T_est[:, :3, :3]
    return align_object_frame(pairs.T_est, T_true)


def _is_tracked(answers: Answers, pairs: PosePairs) -> NDArray[np.bool_]:
    """Which frames have an estimate that is not called lost."""
    tracked = np.zeros(len(pairs.frames), bool)
    tracked[pairs.found] = [pairs.frames[place] not in answers.lost for place in pairs.found]
    return tracked
