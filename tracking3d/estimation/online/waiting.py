"""The first frames: their points are followed and matched until the start can be solved."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.belief import Belief, ObjectMap, View
from tracking3d.estimation.online.keypoints import detect, match
from tracking3d.estimation.online.lens import lens_hypotheses
from tracking3d.estimation.online.mapping import tracks_of
from tracking3d.estimation.online.points import MOST_POINTS, FollowedPoints, new_corners
from tracking3d.estimation.online.start import InitialMap, by_turning, solve_start
from tracking3d.estimation.online.structure import motion_enough
from tracking3d.estimation.online.surface_fit import FitWeights
from tracking3d.estimation.online.texture_strength import PLAIN, texture_strength

MOTION = 0.03
"""Change of form at which a start is tried first, see `motion_enough`."""
_MORE_MOTION = 1.3  # times as much before it is tried again
_DOUBTFUL = 0.5  # bundle cost above which the points do not tell: they are 0.8 pixels off
_MOST = 40  # frames that wait for a better one
_FEWEST = 4  # frames that are solved together
_FEWEST_BY_TURNING = 13
_WILD = 0.15  # change of form that no start explains, though the object can have turned by half a turn since
_AGAIN = 5  # frames after which pixels and outlines are asked once more
_LASTING = 0.4  # share of the first frame's points that are still there where they can be relied on
_LEAST_SHARED = 0.1  # share below which nothing more will be learned of the first frame
_SPARSE = 0.6  # of `MOST_POINTS`, below which new points are looked for
_SAME_PLACE = 1.5  # pixels
_MATCHED_WITH = 3  # frames before
_SLIP = 3  # frames
_LIKE_NOISE = 1.3  # times the change between neighbours that is none
# Logarithm of two costs' ratio, times the change of form, from which the better start is believed; and where it is
# the better one for the second time.
_LEAD, _LEAD_AGAIN = 0.04, 0.02
_MOTION_ENOUGH = 0.3  # change of form from which more of it decides nothing
_WELL_FOLLOWED = 0.25  # bundle cost of points that go on to be
_SAME_AXIS = 0.87  # cosine of 30 degrees
_TWO_WAYS = "the first frames can be explained in two ways, as when near and far are exchanged, until it turns further"
_STILL = "nothing shows that the object turns: it is still, or turns about an axis of its symmetry"


def waiting_view(
    known: ObjectMap, earlier: tuple[View, ...], view: View, image: NDArray[np.uint8]
) -> tuple[ObjectMap, View]:
    """A view whose points are followed, or found again, in it; their depth is not known yet."""
    if _gone((*earlier, view)):
        return known, replace(view, points=FollowedPoints.none())
    if (inside := view.mask) is not None:
        view = replace(view, strength=texture_strength(image, inside))
    if inside is None or len(view.points) >= _SPARSE * MOST_POINTS:
        return known, view
    keypoints = detect(image, inside)
    label = np.full(len(keypoints), -1, np.int64)
    if len(view.points) and len(keypoints):
        gap = np.linalg.norm(keypoints.pixel[:, None] - view.points.pixel[None], axis=2)
        label = np.where(gap.min(1) < _SAME_PLACE, view.points.landmark[gap.argmin(1)], -1)
    taken = set(view.points.landmark.tolist())
    for other in earlier[::-1][:_MATCHED_WITH]:
        for here, there in match(keypoints, other.keypoints):
            name = int(other.keypoint_landmark[there])
            if label[here] < 0 <= name and name not in taken:
                label[here] = name
                taken.add(name)
    corners = new_corners(
        image,
        inside,
        np.concatenate([view.points.pixel, keypoints.pixel]),
        MOST_POINTS - len(view.points) - len(keypoints),
    )
    fresh = label < 0
    base = len(known.landmarks)
    label[fresh] = base + np.arange(fresh.sum())
    corner_names = base + fresh.sum() + np.arange(len(corners))
    own, first = np.unique(label, return_index=True)
    again = ~np.isin(own, view.points.landmark)
    points = FollowedPoints(
        np.concatenate([view.points.landmark, own[again], corner_names]).astype(np.int64),
        np.concatenate([view.points.pixel, keypoints.pixel[first][again], corners]),
    )
    added = int(fresh.sum()) + len(corners)
    known = replace(
        known,
        landmarks=np.concatenate([known.landmarks, np.full((added, 3), np.nan)]),
        candidate=np.concatenate([known.candidate, np.zeros(added, bool)]),
    )
    return known, replace(view, points=points, keypoints=keypoints, keypoint_landmark=label)


def solved_start(
    state: Belief, config: OnlineConfig, ended: bool = False
) -> tuple[Belief, InitialMap | None]:
    """The start, where the waiting frames can tell; else None, and when it is tried next.

    Args:
        state: With the waiting frames.
        config: Of the solver.
        ended: Whether no more frames come, so that these have to do.
    """
    waiting = state.waiting or ()
    views = [view for view, _ in waiting if view.mask is not None]
    if len(views) < _FEWEST:
        return state, None
    ended = ended or _gone([view for view, _ in waiting])  # what was seen until then has to do
    if np.median([view.strength for view in views]) < PLAIN:
        enough = len(views) >= _FEWEST_BY_TURNING and (len(views) - _FEWEST_BY_TURNING) % _AGAIN == 0
        if not enough and not ended:
            return state, None
        return _start_without_points(state, views, config)
    names = np.unique(np.concatenate([view.points.landmark for view in views]))
    motion = motion_enough(tracks_of(views, names[~state.known.candidate[names]]))
    still_there = np.isin(views[0].points.landmark, views[-1].points.landmark)
    shared = float(still_there.mean()) if len(still_there) else 0.0
    waited = ended or len(views) >= _MOST
    # Points that run wild show no more motion when there is more of it: then pixels and outlines are asked.
    wild = motion > _WILD and len(views) >= _FEWEST_BY_TURNING
    due = max(state.due, MOTION)
    if motion < due and not waited and shared > _LEAST_SHARED and not (wild and len(views) % _AGAIN == 0):
        return state, None
    state = replace(state, due=motion * _MORE_MOTION)
    may_wait = not waited and shared > _LEAST_SHARED and motion < _MOTION_ENOUGH
    # Without motion any shape explains the points.
    starts = _starts_from_points(state, views, config) if motion >= MOTION else []
    if may_wait and _undecided(starts, motion, state.leaning):
        return replace(state, waits_for=_TWO_WAYS, undecided=len(views), leaning=_turn(starts[0])), None
    if state.undecided and starts and starts[0].bundle > _WELL_FOLLOWED:
        starts = _starts_from_points(state, views[: state.undecided], config)
    if not starts or starts[0].bundle > _DOUBTFUL:
        if not waited and not wild and (shared > _LASTING or len(views) < _FEWEST_BY_TURNING):
            return state, None
        state, turning = _start_without_points(state, views, config)
        if turning is None:
            return state, None
        starts = sorted([*starts, turning], key=lambda start: start.cost)
    return state, starts[0] if starts else None


def _starts_from_points(state: Belief, views: list[View], config: OnlineConfig) -> list[InitialMap]:
    weights = FitWeights(smoothness=config.smoothness)
    return solve_start(state.known, lens_hypotheses(state.camera), views, weights, config.surface_prior)


def _start_without_points(
    state: Belief, views: list[View], config: OnlineConfig
) -> tuple[Belief, InitialMap | None]:
    """The start from pixels and outlines alone; None where nothing shows that the object turns."""
    waiting = state.waiting or ()
    if not _changed(views):
        kept = _fewer(waiting) if len(views) >= _MOST else waiting
        return replace(state, waiting=kept, waits_for=_STILL, undecided=0), None
    return state, by_turning(state.known, state.camera, views, FitWeights(smoothness=config.smoothness))[0]


def _undecided(starts: list[InitialMap], motion: float, leaning: NDArray[np.float64] | None) -> bool:
    """Whether another start, whose object turns otherwise, costs hardly more than the best for so little motion.

    Only points that are followed well tell more when there is more motion.

    Args:
        starts: By rising cost.
        motion: See `motion_enough`.
        leaning: How the object turned in the best start when it was tried last: what wins twice needs to win by less.
    """
    if len(starts) < 2 or starts[0].bundle > _WELL_FOLLOWED:
        return False
    best = _turn(starts[0])
    rivals = [start for start in starts[1:] if not _same_axis(best, _turn(start))]
    if not rivals:
        return False
    lead = motion * math.log(rivals[0].cost / max(starts[0].cost, 1e-9))
    again = leaning is not None and _same_axis(best, leaning)
    return lead < (_LEAD_AGAIN if again else _LEAD)


def _turn(start: InitialMap) -> NDArray[np.float64]:
    """``(3,)`` rotation vector from the first view of a start to the last, in camera coordinates."""
    first, *_, last = start.known.keyframes
    return Rotation.from_matrix((last.pose.R @ first.pose.R.T).cpu().numpy()).as_rotvec()


def _same_axis(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether two turns are about the same axis; by how much depends on the lens and on the relief."""
    return bool(a @ b >= _SAME_AXIS * np.linalg.norm(a) * np.linalg.norm(b))


def _gone(views: Sequence[View]) -> bool:
    """Whether the object is out of sight for longer than a mask tracker's slip."""
    return len(views) > _SLIP and all(view.mask is None for view in views[-_SLIP:])


def _changed(views: list[View]) -> bool:
    """Whether the object looks different now: by more, inside both masks, than from one frame to the next."""

    def difference(a: View, b: View) -> float:
        both = (a.observation.mask * b.observation.mask) > 0.5
        if not bool(both.any()):
            return 0.0
        return float((a.observation.features - b.observation.features)[:, both].abs().mean())

    neighbours = [difference(a, b) for a, b in pairwise(views)]
    return difference(views[0], views[-1]) > _LIKE_NOISE * float(np.median(neighbours))


def _fewer(waiting: tuple[tuple[View, FrameEstimate], ...]) -> tuple[tuple[View, FrameEstimate], ...]:
    """Every second of the waiting frames, with the first and the last."""
    return (*waiting[:-1:2], waiting[-1])
