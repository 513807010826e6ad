"""COLMAP on the object of a clip alone, and how many views it and runs of tracking3d place right."""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.results.files import write_mask
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.readers.colmap import answers_from_colmap
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.pose_scores import NO_ESTIMATE, pair_poses, rotation_errors

RIGHT = 10.0
"""Degrees below which a view counts as placed right."""

# What lets COLMAP join more views of a small object (chosen by trial on the sets of photos): contrast of a keypoint,
# and fewer matches, and a smaller angle, than it asks for by default.
_PEAK, _MATCHES, _FIRST_PAIR, _ADDED, _ANGLE = 0.002, 10, 25, 12, 6.0
_FEWEST = 3  # views of a model
_STARTS = 40  # of the fit of an axis
_TILT = 0.5  # of their axes from upright


@dataclass(frozen=True, kw_only=True)
class PeerRow:
    """How one system placed the views of a clip."""

    system: str
    views: int  # that it was asked for
    placed: int  # of these, with a pose that it does not call lost
    within_10_deg: int  # of these, with a rotation error below `RIGHT`
    mean_of_placed_deg: float | None  # rotation error
    largest_of_placed_deg: float | None
    mean_deg: float  # over all views; 180 for those without a pose
    tracked: int | None = None  # that it calls tracked; None if it does not say
    tracked_and_wrong: int | None = None  # of these, with an error above `RIGHT`
    processor_seconds: float | None = None


def score_views(
    system: str, answers: Answers, truth: Truth, step: float | None, seconds: float | None
) -> PeerRow:
    """Score the rotations of the views that were asked for.

    Args:
        system: What the row calls it.
        answers: The estimates.
        truth: The clip.
        step: Degrees by which the object turns on from view to view, see `turntable_errors`; None where the clip has
            poses.
        seconds: Processor time that it took, if known.
    """
    asked, poses = list(answers.asked), answers.T_cam_obj or {}
    posed = [n for n in asked if n in poses]
    errors = dict.fromkeys(asked, NO_ESTIMATE)
    if step is None:
        pairs = pair_poses(answers, truth)
        if pairs is None:
            raise InputError(
                f"The clip {truth.name} has no poses; give --step, the degrees between two views."
            )
        errors = rotation_errors(pairs)
    elif len(posed) >= _FEWEST:
        R = np.array([poses[n][:3, :3] for n in posed])
        errors |= dict(zip(posed, turntable_errors(R, step * np.array(posed)).tolist(), strict=True))
    placed = np.array([errors[n] for n in errors if n in poses and n not in answers.lost])
    tracked = answers.tracked
    return PeerRow(
        system=system,
        views=len(errors),
        placed=len(placed),
        within_10_deg=int(np.count_nonzero(placed < RIGHT)),
        mean_of_placed_deg=float(placed.mean()) if len(placed) else None,
        largest_of_placed_deg=float(placed.max()) if len(placed) else None,
        mean_deg=float(np.mean(list(errors.values()))),
        tracked=None if tracked is None else len(tracked & errors.keys()),
        tracked_and_wrong=None
        if tracked is None
        else sum(errors[n] > RIGHT for n in tracked & errors.keys()),
        processor_seconds=seconds,
    )


def turntable_errors(R: NDArray[np.float64], turned: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation errors of views of a turntable that turns by known angles about an axis that nobody has measured.

    The axis is fitted, and so is the rotation of the object, so that a minority of wrong views does not decide. Its
    direction lies in the upper half of the picture, and what is in front moves to the right: a solution that is
    reversed in depth does not pass.

    Args:
        R: ``(N, 3, 3)`` estimates, object to camera; at least three.
        turned: ``(N,)`` degrees by which the table has turned.

    Returns:
        ``(N,)`` degrees.
    """
    estimated, turns = Rotation.from_matrix(R), np.radians(turned)

    def errors(p: NDArray[np.float64]) -> NDArray[np.float64]:
        expected = Rotation.from_rotvec(np.outer(turns, p[:3] / np.linalg.norm(p[:3])))
        return np.asarray((expected * Rotation.from_rotvec(p[3:]) * estimated.inv()).magnitude())

    rng, best, least = np.random.default_rng(0), np.full(len(turns), NO_ESTIMATE), np.inf
    for start in range(_STARTS):
        axis = np.array([0.0, -1.0, 0.0]) + _TILT * rng.normal(size=3) * (start > 0)
        view = rng.integers(len(turns))
        first = Rotation.from_rotvec(-turns[view] * axis / np.linalg.norm(axis)) * estimated[view]
        fit = least_squares(
            lambda p: np.sin(errors(p) / 2), np.r_[axis, first.as_rotvec()], loss="soft_l1", f_scale=0.05
        )
        if fit.x[1] < 0 and fit.cost < least:
            best, least = np.degrees(errors(fit.x)), fit.cost
    return best


def run_colmap(truth: Truth, asked: range, *, lowered: bool) -> tuple[Answers, float]:
    """Poses by COLMAP from the views and the masks of a clip: keypoints in masks, all pairs, incremental mapping.

    Args:
        truth: The clip; every view has a mask.
        asked: The views.
        lowered: With lower thresholds than its own, which suit a small object.

    Returns:
        The poses, none if it finds no model, and its processor seconds.

    Raises:
        InputError: If pycolmap is not installed, or a view has no mask.
    """
    missing = [truth.names[n] for n in asked if n not in truth.masks]
    if missing:
        raise InputError(f"The clip {truth.name} has no mask of view {missing[0]}, which COLMAP needs.")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for folder in ("images", "masks", "models"):
            (work / folder).mkdir()
        for n in asked:
            file = truth.frames[n]
            (work / "images" / file.name).symlink_to(file.resolve())
            write_mask(work / "masks" / f"{file.name}.png", truth.masks[n].read())
        # In a process of its own: pycolmap brings libraries that torch has in other versions.
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
            found, seconds = pool.submit(_map_images, work, lowered).result()
        none = Answers(truth.frames[0].parent, asked, frozenset(asked), T_cam_obj={})
        answers = answers_from_colmap(work / "models", truth) if found else none
        return replace(answers, asked=asked), seconds


def _map_images(work: Path, lowered: bool) -> tuple[int, float]:
    """Write models of ``work/images`` into ``work/models``; how many, and processor seconds."""
    try:
        import pycolmap
    except ImportError as error:
        raise InputError("COLMAP is not installed: pip install 'tracking3d-bench[colmap]'.") from error
    pycolmap.logging.minloglevel = 3
    reading = pycolmap.ImageReaderOptions()
    reading.mask_path, reading.camera_model = str(work / "masks"), "SIMPLE_PINHOLE"
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    verification, mapping = pycolmap.TwoViewGeometryOptions(), pycolmap.IncrementalPipelineOptions()
    for options in (extraction, matching):
        options.use_gpu = False
    for options in (extraction, matching, mapping):
        options.num_threads = 1
    mapping.random_seed = verification.ransac.random_seed = 1
    mapping.min_model_size = _FEWEST
    if lowered:
        extraction.sift.peak_threshold = _PEAK
        verification.min_num_inliers = mapping.min_num_matches = _MATCHES
        mapping.mapper.init_min_num_inliers = _FIRST_PAIR
        mapping.mapper.abs_pose_min_num_inliers = _ADDED
        mapping.mapper.init_min_tri_angle = _ANGLE
    began, database = time.process_time(), work / "database.db"
    pycolmap.extract_features(
        database,
        work / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reading,
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(database, matching_options=matching, verification_options=verification)
    models = pycolmap.incremental_mapping(database, work / "images", work / "models", options=mapping)
    return len(models), time.process_time() - began
