"""The similarity between the objects of two runs that show the same thing in different videos.

Keypoints of both videos are matched, frame by frame; each lies on the surface of its own run. Three matches give a
similarity (Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991), and the
one that most matches of all pairs of frames agree with is taken (Fischler and Bolles, 1981). It is refined so that each
surface point is seen where the other video shows it: surfaces are known less well than pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.estimation.online.features.sift import match
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.surface_keypoints import SurfaceKeypoints
from tracking3d.runtime.progress import report_each

FEWEST_MATCHES, FEWEST_PAIRS = 30, 3
"""Matches that have to agree on a similarity, and pairs of frames that they have to come from."""
_LEAST_OF_PAIR = 6  # matches of a pair of frames that hypotheses are made from
_HYPOTHESES = 3000
_TESTED = 4000  # matches that a hypothesis is tested by
_TOLERANCE = 0.04  # of the object's size, between matched points
_PIXELS = 4.0  # of an object of 200 pixels, beyond which a refined match is wrong
_SIZE = 200.0

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Registration:
    """How another run's object lies in the coordinates of a run."""

    similarity: Similarity  # from the other run's object coordinates to those of the run
    matches: int  # matches that agree with it
    pairs: int  # pairs of frames that these come from
    error: float  # median reprojection error of these, in pixels of an object 200 pixels large


@dataclass(frozen=True, eq=False)
class _Matches:
    """M matches: points ``(M, 3)`` of both runs, their pixels ``(M, 2)``, frames, and pixels per unit of error."""

    own: FloatArray
    other: FloatArray
    own_pixel: FloatArray
    other_pixel: FloatArray
    own_P: FloatArray
    other_P: FloatArray
    own_scale: FloatArray
    other_scale: FloatArray
    pair: NDArray[np.int64]

    def only(self, kept: NDArray[np.bool_]) -> _Matches:
        return _Matches(*(getattr(self, name)[kept] for name in self.__dataclass_fields__))


def register_run(
    own: Sequence[SurfaceKeypoints], other: Sequence[SurfaceKeypoints], seed: int = 0
) -> Registration:
    """Register another run's object with that of a run.

    Args:
        own: Frames of the run.
        other: Frames of the other run.
        seed: Of the hypotheses.

    Raises:
        InputError: If too few matches agree.
    """
    matches = _match_frames(own, other)
    similarity = _best_hypothesis(matches, np.random.default_rng(seed)) if len(matches.pair) >= 3 else None
    if similarity is not None:
        apart = np.linalg.norm(similarity.points(matches.other) - matches.own, axis=1)
        inliers = matches.only(apart < _TOLERANCE * _size(matches.own))
        for _ in range(2):
            similarity = _refine(similarity, inliers)
            inliers = matches.only(_reprojection_errors(similarity, matches).max(1) < _PIXELS)
            if len(inliers.pair) < FEWEST_MATCHES:
                break
        pairs = len(np.unique(inliers.pair))
        if len(inliers.pair) >= FEWEST_MATCHES and pairs >= FEWEST_PAIRS:
            error = float(np.median(_reprojection_errors(similarity, inliers)))
            return Registration(similarity, len(inliers.pair), pairs, error)
    raise InputError(
        "The two videos show too little of the object in common: fewer than "
        f"{FEWEST_MATCHES} matched keypoints agree on how one lies in the other. Let the second video begin with a "
        "side that the first shows, printed or patterned, and turn the object from there."
    )


def _match_frames(own: Sequence[SurfaceKeypoints], other: Sequence[SurfaceKeypoints]) -> _Matches:
    found = []
    for number, mine in enumerate(report_each("matching the videos", own)):
        for place, theirs in enumerate(other):
            pairs = match(mine.keypoints, theirs.keypoints)
            if len(pairs) < _LEAST_OF_PAIR:
                continue
            a, b = pairs.T
            count = len(pairs)
            found.append(
                _Matches(
                    mine.points[a],
                    theirs.points[b],
                    mine.keypoints.pixel[a].astype(np.float64),
                    theirs.keypoints.pixel[b].astype(np.float64),
                    np.broadcast_to(mine.P, (count, 3, 4)),
                    np.broadcast_to(theirs.P, (count, 3, 4)),
                    np.full(count, max(mine.length / _SIZE, 0.25)),
                    np.full(count, max(theirs.length / _SIZE, 0.25)),
                    np.full(count, number * len(other) + place),
                )
            )
    if not found:
        empty = np.zeros((0, 3))
        pixels, P = np.zeros((0, 2)), np.zeros((0, 3, 4))
        one = np.zeros(0)
        return _Matches(empty, empty, pixels, pixels, P, P, one, one, np.zeros(0, np.int64))
    return _Matches(
        *(np.concatenate([getattr(one, name) for one in found]) for name in _Matches.__dataclass_fields__)
    )


def _size(points: FloatArray) -> float:
    return float(np.linalg.norm(np.percentile(points, 95, axis=0) - np.percentile(points, 5, axis=0)))


def _best_hypothesis(matches: _Matches, random: np.random.Generator) -> Similarity | None:
    """The similarity, of many from three matches of one pair of frames each, that most matches agree with."""
    tested = random.permutation(len(matches.pair))[:_TESTED]
    own, other = matches.own[tested], matches.other[tested]
    tolerance = _TOLERANCE * _size(matches.own)
    _, first, count = np.unique(matches.pair, return_index=True, return_counts=True)
    best, most = None, 0
    chosen = random.choice(len(first), _HYPOTHESES, p=count / count.sum())
    for pair in chosen:
        three = first[pair] + random.choice(count[pair], 3, replace=False)
        similarity = fit_points(matches.own[three], matches.other[three])
        if similarity is None:
            continue
        agreeing = int((np.linalg.norm(similarity.points(other) - own, axis=1) < tolerance).sum())
        if agreeing > most:
            best, most = similarity, agreeing
    return best


def fit_points(own: FloatArray, other: FloatArray) -> Similarity | None:
    """The similarity that takes points ``(N, 3)`` ``other`` to ``own`` best; None if they lie on a line."""
    own_middle, other_middle = own.mean(0), other.mean(0)
    a, b = own - own_middle, other - other_middle
    spread = float((b**2).sum())
    U, values, Vt = np.linalg.svd(a.T @ b)
    if spread <= 0 or values[1] < 1e-9 * max(values[0], 1e-300):
        return None
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U @ turn @ Vt
    scale = float((values * np.diag(turn)).sum() / spread)
    return Similarity(R, scale, own_middle - scale * R @ other_middle) if scale > 0 else None


def _refine(first: Similarity, matches: _Matches) -> Similarity:
    """The similarity with the least reprojection errors, large ones counting less."""

    def change(x: FloatArray) -> Similarity:
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ first.R
        return Similarity(R, first.scale * float(np.exp(x[3])), first.translation + x[4:])

    solved = least_squares(
        lambda x: _reprojections(change(x), matches).ravel(), np.zeros(7), loss="soft_l1", x_scale="jac"
    )
    return change(solved.x)


def _reprojection_errors(similarity: Similarity, matches: _Matches) -> FloatArray:
    """``(M, 2)`` distances, in the run's frames and in the other's."""
    return np.asarray(np.linalg.norm(_reprojections(similarity, matches), axis=2))


def _reprojections(similarity: Similarity, matches: _Matches) -> FloatArray:
    """``(M, 2, 2)`` errors of the other's points in the run's frames, and the reverse, for an object of 200 pixels."""
    inverse = (matches.own - similarity.translation) @ similarity.R / similarity.scale
    return np.stack(
        [
            (_project(matches.own_P, similarity.points(matches.other)) - matches.own_pixel)
            / matches.own_scale[:, None],
            (_project(matches.other_P, inverse) - matches.other_pixel) / matches.other_scale[:, None],
        ],
        axis=1,
    )


def _project(P: FloatArray, points: FloatArray) -> FloatArray:
    seen = np.einsum("nij,nj->ni", P[:, :, :3], points) + P[:, :, 3]
    return np.asarray(seen[:, :2] / np.where(np.abs(seen[:, 2:]) < 1e-9, 1e-9, seen[:, 2:]))
