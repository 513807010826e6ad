"""The model of an object from several videos: each shows sides that the others do not.

The object of an earlier run is registered with that of a run (`registration`), and the frames of both make one surface
and one texture, in the coordinates of the run. An earlier run that extends others brings their frames, too.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.estimation.online.features.sift import match
from tracking3d.geometry.similarity import Similarity
from tracking3d.reconstruction.rebuild import EXTENDS, ShapedRun, check_packages, online_model, reshape_run
from tracking3d.reconstruction.run_views import (
    RunViews,
    SurfaceKeypoints,
    collect_views,
    no_reliable_frame_error,
)
from tracking3d.reconstruction.seen_regions import close_unseen
from tracking3d.results import layout
from tracking3d.results.layout import METRE
from tracking3d.results.mesh_export import load_model
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader, open_run_source
from tracking3d.results.run_unit import unit_scale
from tracking3d.runtime.progress import report_each
from tracking3d.video.source import FrameSource

# The similarity between the objects of two runs that show the same thing in different videos.
#
# Keypoints of both videos are matched, frame by frame; each lies on the surface of its own run. Three matches give a
# similarity (Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991), and
# the one that most matches of all pairs of frames agree with is taken (Fischler and Bolles, 1981). It is refined so
# that each surface point is seen where the other video shows it: surfaces are known less well than pixels.

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


_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class ExtendedRun:
    """What came of it."""

    shaped: ShapedRun  # the model
    registration: Registration  # how the earlier run's object lies in the coordinates of this one

    @property
    def sentence(self) -> str:
        """What came of it, in a sentence."""
        found = self.registration
        matched = f"{found.matches} matched keypoints in {found.pairs} pairs of frames"
        registered = f"{matched} tell how the earlier object lies in this one"
        if not self.shaped.new:
            return f"{registered}, but the mesh is made from this video alone. {self.shaped.sentence}"
        return f"{registered}; {self.shaped.sentence}"


def extend_run(
    folder: Path,
    earlier: Path,
    source: str | FrameSource | None = None,
    most: int = 24,
    largest: int = 2048,
) -> ExtendedRun:
    """Make the model of a run from its frames and those of an earlier run of the same object, and write it.

    How the earlier object lies in the run's coordinates is noted in ``run.json`` under `EXTENDS`, if its frames made
    the mesh. A run that extended another one before extends this one instead.

    Args:
        folder: The run folder.
        earlier: That of the earlier run; it stays as it is.
        source: The run's video, or its path; None for the one that the run names.
        most: Frames of each run that the texture is taken from.
        largest: Most texels along a side.

    Raises:
        InputError: If a package is missing, a run goes on, has no mesh or no reliable frame, its video cannot be
            read, or the two show too little in common.
        OutputError: If the mesh cannot be written.
    """
    check_packages()
    if folder.resolve() == earlier.resolve():
        raise InputError(f"{folder} cannot extend itself; give the folder of another run.")
    run, known = RunReader(folder), RunReader(earlier)
    online = online_model(run)
    own = collect_views(run, source, most, online)
    other = _views_of_earlier(known, most, load_model(known.mesh_folder))
    for one, views in ((run, own), (known, other)):
        if not views.textures:
            raise no_reliable_frame_error(one)
    registration = register_run(own.keypoints, other.keypoints)
    parts, models = [own], []
    runs = [(known, registration.similarity, other)]
    runs += _runs_extended_by(known, registration.similarity, most, folder)
    for number, (one, similarity, views) in enumerate(runs, start=1):
        parts.append(views.moved(similarity, number))
        models.append(_moved(load_model(one.mesh_folder), similarity))
    together = RunViews(
        [view for part in parts for view in part.shapes],
        [view for part in parts for view in part.left_out],
        tuple(view for part in parts for view in part.textures),
    )
    shaped = reshape_run(run, close_unseen(online), together, largest, models, own.textures)
    if shaped.new:
        scales = {"own_unit": unit_scale(run), "earlier_unit": unit_scale(known)}
        note_in_run(folder, {EXTENDS: {"run": str(earlier.resolve()), **_describe(registration), **scales}})
    return ExtendedRun(shaped, registration)


def check_earlier_run(earlier: Path) -> None:
    """Make sure that a run can be extended, as far as that can be seen before its video is read.

    Raises:
        InputError: If it is no run, still going, or its video is not there.
    """
    run = RunReader(earlier)
    if run.state == "running":
        raise InputError(f"The run {earlier} is still going; wait for its end.")
    _open_earlier(run)


def _open_earlier(run: RunReader) -> FrameSource:
    try:
        return open_run_source(run)
    except InputError as error:
        raise InputError(
            f"The video of the earlier run {run.folder} cannot be read; put it where its run.json says it was: "
            f"{run.description.get('source')!r:.200}."
        ) from error


def _views_of_earlier(run: RunReader, most: int, model: ObjectModel | None = None) -> RunViews:
    return collect_views(run, _open_earlier(run), most, model)


def _runs_extended_by(
    run: RunReader, similarity: Similarity, most: int, own: Path
) -> Iterator[tuple[RunReader, Similarity, RunViews]]:
    """The runs that a run extends itself, each with the similarity to the coordinates that ``similarity`` leads to.

    One that cannot be read, or its video, ends the chain with a warning: what is there is used.

    Args:
        run: The run.
        similarity: From its object coordinates.
        most: Frames that a texture is taken from.
        own: The run folder that is extended, whose frames are there already.
    """
    visited = {own.resolve(), run.folder.resolve()}
    while (note := run.description.get(EXTENDS)) is not None:
        try:
            earlier, to_run = _parse_note(run, note)
            if earlier.resolve() in visited:
                return
            visited.add(earlier.resolve())
            views = _views_of_earlier(RunReader(earlier), most)
            similarity = similarity.after(to_run)
        except InputError as error:
            _log.warning("%s is extended without the runs that it extends itself: %s", run.folder, error)
            return
        run = RunReader(earlier)
        yield run, similarity, views


def between_runs(run: RunReader, other: RunReader) -> Similarity:
    """From the object coordinates of a run to those of another one that has its object.

    One was tracked by ``--object`` of the other, with or without ``--extend``, or both have the object of a third.

    Raises:
        InputError: If they share no object.
    """
    known = dict(_objects_of(run))
    for folder, similarity in _objects_of(other):
        if folder in known:
            return similarity.inverse.after(known[folder])
    raise InputError(
        f"The runs {run.folder} and {other.folder} share no object; track the video of one with --object and the run "
        "of the other, with or without --extend."
    )


def _objects_of(run: RunReader) -> Iterator[tuple[Path, Similarity]]:
    """A run and those that its object is from, each with the similarity from the run's coordinates to its own."""
    similarity, visited = Similarity.identity(), set[Path]()
    while (here := run.folder.resolve()) not in visited:
        visited.add(here)
        yield here, similarity
        note, model = run.description.get(EXTENDS), run.config.get("object", {}).get("model")
        try:
            if note is not None:
                earlier, to_run = _parse_note(run, note)
                before = RunReader(earlier)
            elif model is not None and Path(model).is_dir():
                before = RunReader(Path(model))
                # A run of an object in metres is in metres; else either may have been put into metres since.
                own = (
                    1.0
                    if run.unit == METRE and unit_scale(run) == 1
                    else unit_scale(run) / unit_scale(before)
                )
                to_run = Similarity(np.eye(3), own, np.zeros(3))
            else:
                return
        except InputError:  # the earlier run is gone
            return
        run, similarity = before, to_run.inverse.after(similarity)


def _parse_note(run: RunReader, note: Any) -> tuple[Path, Similarity]:
    """The earlier run that a note names, and the similarity from its present coordinates to the run's.

    Raises:
        InputError: If the note is damaged.
    """
    try:
        earlier = Path(note["run"])
        R, translation = np.array(note["R"], float), np.array(note["translation"], float)
        scale = float(note["scale"])
        own_unit, earlier_unit = float(note.get("own_unit", 1.0)), float(note.get("earlier_unit", 1.0))
        numbers = [*R.ravel(), *translation, scale, own_unit, earlier_unit]
        sound = R.shape == (3, 3) and translation.shape == (3,) and np.isfinite(numbers).all() and scale > 0
    except (AttributeError, KeyError, TypeError, ValueError):
        sound = False
    if not sound:
        raise InputError(f"{run.folder / layout.RUN} is damaged: {EXTENDS} is {note!r:.60}; restore it.")
    # Either run may have been put into metres since.
    own, other = unit_scale(run) / own_unit, unit_scale(RunReader(earlier)) / earlier_unit
    return earlier, Similarity(R, scale * own / other, translation * own)


def _moved(model: ObjectModel, similarity: Similarity) -> ObjectModel:
    return replace(model, vertices=similarity.points(model.vertices))


def _describe(registration: Registration) -> dict[str, Any]:
    similarity = registration.similarity
    return {
        "R": similarity.R.tolist(),
        "scale": similarity.scale,
        "translation": similarity.translation.tolist(),
        "matches": registration.matches,
        "pairs_of_frames": registration.pairs,
        "reprojection_error": round(registration.error, 3),
    }
