"""An object that was lost and is seen again from a side that nobody knows: a second start, with a map of its own.

How the second map lies to the first is a guess at first: the object is taken to have gone on turning as it did. While
one of them is tracked against, the others stand aside. Where a side that one of them knows is met in the other, both
become one. What is never joined stays as it was answered.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.estimate import GUESSED, FrameEstimate, Status
from tracking3d.estimation.online.belief import Aside, Belief, ObjectMap, View
from tracking3d.estimation.online.final_refinement import keyframe_cost, refined_once_more
from tracking3d.estimation.online.growing import refined
from tracking3d.estimation.online.judgement import BELIEVED, ENOUGH_POINTS, Usual
from tracking3d.estimation.online.lens import through
from tracking3d.estimation.online.mapping import pose_arrays
from tracking3d.estimation.online.points import MOST_FOLLOWED, FollowedPoints
from tracking3d.estimation.online.tracking import coast, matched_poses, pixel_scale
from tracking3d.estimation.online.uniting import moved, moved_pose, same_landmarks, united
from tracking3d.evidence import as_lab
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.similarity import Similarity

_SAME_MASK = 0.3  # IoU of the masks of two frames, below which they are of two things
_OTHER_COLOURS = -0.5  # mean log ratio of colours from which a mask is of something else
_UNPROVEN = 0.05  # confidence at most while how two maps lie to each other is a guess
_FEWEST_PAIRS = 6  # landmarks of both maps that say how they lie to each other
_MOST_VIEWS = 24  # of another map that a keyframe is compared with
_MOST_ASIDE = 4
_WORSE = 1.2  # times what keyframes cost, from which two maps are none
_REASON = (
    "re-initialized after tracking was lost; the pose relative to the earlier map is unknown until a known side is "
    "seen"
)


def of_one_thing(before: NDArray[np.bool_] | None, mask: NDArray[np.bool_]) -> bool:
    """Whether two frames' masks ``(H, W)`` overlap, as those of one thing do."""
    if before is None:
        return False
    either = int(np.count_nonzero(before | mask))
    return int(np.count_nonzero(before & mask)) > _SAME_MASK * either


def is_whole(mask: NDArray[np.bool_]) -> bool:
    """Whether a mask ``(H, W)`` stays off the frame's border: an object that comes in shows little of itself."""
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(mask.any() and not border.any())


def looks_alike(state: Belief, frame: Frame, mask: NDArray[np.bool_]) -> bool:
    """Whether what is in a mask ``(H, W)`` has no colours that speak against the object."""
    if state.colours is None:
        return True
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    crop = slice(y, y + height), slice(x, x + width)
    ratio = state.colours.log_ratio(as_lab(np.ascontiguousarray(frame.image[crop])))
    return float(ratio[mask[crop]].mean()) > _OTHER_COLOURS


def believable(begun: Belief, answer: FrameEstimate) -> bool:
    """Whether a second start is one that can be gone on from."""
    return not begun.known.pointless and answer.confidence >= BELIEVED


def guess(state: Belief, begun: Belief) -> Similarity:
    """From a second start's coordinates to those of a lost map: as large, and turned on as it did before the loss.

    Args:
        state: With the lost map.
        begun: The second start.
    """
    turns = []
    for view in begun.known.keyframes:
        R_before, _ = pose_arrays(coast(state.trail, view.index))
        turns.append(R_before.T @ pose_arrays(view.pose)[0])
    # The rotation nearest to all of them.
    u, _, vt = np.linalg.svd(np.sum(turns, 0))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    scale = _size(state.known) / _size(begun.known)
    centre_before, centre_anew = (
        known.vertices.double().mean(0).cpu().numpy() for known in (state.known, begun.known)
    )
    return Similarity(R, scale, centre_before - scale * R @ centre_anew)


def _size(known: ObjectMap) -> float:
    """How large the object is, but for a factor that is the same for all of its maps: as seen, at its distance.

    What no view shows of a surface is a guess, and often far too deep or flat.
    """
    seen = [
        float(view.pose.translation[2]) * np.sqrt(np.count_nonzero(view.mask))
        for view in known.keyframes
        if view.mask is not None and view.mask.any()
    ]
    return float(np.median(seen)) if seen else 1.0


def adopted(state: Belief, begun: Belief, similarity: Similarity) -> Belief:
    """The belief that goes on with a second start; the map of before stands aside.

    Args:
        state: With the lost map.
        begun: The second start, in its own coordinates.
        similarity: From those to the lost map's.
    """
    shape = begun.known.shape
    rest = torch.from_numpy(similarity.points(shape.rest.double().cpu().numpy())).to(shape.rest)
    known = replace(moved(begun.known, similarity), shape=replace(shape, rest=rest))
    first = known.keyframes[0].index
    before, now = begun.before, begun.last
    return replace(
        begun,
        camera=state.camera,
        known=known,
        surface=known.surface(),
        last=(moved_pose(now[0], similarity), now[1]),
        before=before and (moved_pose(before[0], similarity), before[1]),
        trail=tuple((moved_pose(pose, similarity), index) for pose, index in begun.trail),
        colours=state.colours,
        aside=_kept((*state.aside, _aside(state, (*state.spans, (state.since, first - 1))))),
        since=first,
        guessed=True,
    )


def _aside(state: Belief, spans: tuple[tuple[int, int], ...]) -> Aside:
    """The present map as one that stands aside."""
    assert state.surface is not None
    return Aside(state.known, state.surface, state.usual, spans, state.guessed)


def _kept(aside: tuple[Aside, ...]) -> tuple[Aside, ...]:
    """Not more than a few maps: those with most keyframes, in the order that they were in."""
    fewest_first = sorted(aside, key=lambda other: len(other.known.keyframes))
    dropped = fewest_first[: max(len(aside) - _MOST_ASIDE, 0)]
    return tuple(other for other in aside if not any(other is one for one in dropped))


def in_place(answer: FrameEstimate, similarity: Similarity, camera: Camera) -> FrameEstimate:
    """Answers of a second start as of the lost object."""
    T = similarity.poses(answer.T_cam_obj[None].astype(np.float64))[0].astype(answer.T_cam_obj.dtype)
    revised = tuple(in_place(one, similarity, camera) for one in answer.revised)
    return doubted(replace(answer, T_cam_obj=T, camera=camera, revised=revised))


def doubted(answer: FrameEstimate) -> FrameEstimate:
    """An answer against a map of which it is a guess how it lies to the first: lost, whatever its mask is worth."""
    if answer.status is Status.LOST:
        return answer
    return replace(
        answer,
        status=Status.LOST,
        reason=_REASON,
        confidence=min(answer.confidence, _UNPROVEN),
        losses=dict(answer.losses) | {GUESSED: 1.0},
    )


def turned_to(state: Belief, other: Aside, index: int) -> Belief:
    """The belief that goes on from frame ``index`` with a map that stood aside; the object is still lost."""
    return replace(
        _against(state, other, (*state.spans, (state.since, index - 1))),
        lost_for=max(state.lost_for, 1),
        since=index,
        anew=None,
    )


def of_frame(state: Belief, index: int) -> Belief:
    """The belief, past its last frame, with the map that answered frame ``index``."""
    if any(first <= index <= last for first, last in state.spans):
        return state
    for other in state.aside:
        if any(first <= index <= last for first, last in other.spans):
            return _against(state, other, state.spans)
    return state


def largest_of(state: Belief) -> Belief:
    """The belief with the map of most keyframes, of two the earlier; of it the mesh is made."""

    def rank(known: ObjectMap, since: int) -> tuple[int, int]:
        return len(known.keyframes), -since

    largest = max(state.aside, key=lambda other: rank(other.known, other.spans[0][0]), default=None)
    since = state.spans[0][0] if state.spans else state.since
    if largest is None or rank(largest.known, largest.spans[0][0]) <= rank(state.known, since):
        return state
    return _against(state, largest, state.spans or ((state.since, state.last[1]),))


def refined_aside(other: Aside, before: Camera, after: Camera, config: OnlineConfig) -> Aside:
    """A map that stands aside, through the lens of the end and all its keyframes together once more.

    How it lies to the one that the mesh is made of is a guess, whichever of them was the first.
    """
    keyframes = other.known.keyframes
    if after != before:
        keyframes = tuple(through(view, before, after) for view in keyframes)
    known = replace(other.known, keyframes=keyframes)
    known, _ = refined_once_more(known, replace(after, assumed=False), config)
    return replace(other, known=known, surface=known.surface(), guessed=True)


def _against(state: Belief, other: Aside, spans: tuple[tuple[int, int], ...]) -> Belief:
    """The belief with another map, and the present one, which answered ``spans``, aside."""
    newest = other.known.keyframes[-1]
    return replace(
        state,
        trail=((newest.pose, newest.index),),
        known=other.known,
        surface=other.surface,
        usual=other.usual,
        guessed=other.guessed,
        spans=other.spans,
        aside=(*(one for one in state.aside if one is not other), _aside(state, spans)),
        before=None,
        followed=FollowedPoints.none(),
        past=(),
        tried=None,
    )


def joined(state: Belief, config: OnlineConfig, views: tuple[View, ...]) -> Belief:
    """The belief with the maps joined of which some views of the present one show how they lie to each other.

    Args:
        state: Between two frames; its last frame is the newest keyframe.
        config: Of the solver.
        views: Keyframes of the present map that are compared with the others.
    """
    indices = {view.index for view in views}
    for other in state.aside:
        # Joining gives landmarks new names, so that the views are other ones then.
        for view in (view for view in state.known.keyframes if view.index in indices):
            similarity = _shown(state.known, other.known, state.camera, view)
            known = None if similarity is None else _as_one(state, other.known, similarity, config)
            if similarity is not None and known is not None:
                state = _with_joined(state, other, similarity, known)
                break
    return state


def _shown(known: ObjectMap, other: ObjectMap, camera: Camera, view: View) -> Similarity | None:
    """From a map's coordinates to another's, by what one view shows of both; None where it does not."""
    count = len(other.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_VIEWS)).round().astype(int))
    compared = [other.keyframes[position] for position in chosen]
    found = matched_poses(other, camera, view.keypoints, compared, pixel_scale(view))
    if not found or len(found[0][1]) < ENOUGH_POINTS:
        return None
    pose, points = found[0]
    gap = np.linalg.norm(points.pixel[:, None] - view.keypoints.pixel[None], axis=2)
    label = np.where(gap.min(1) < 0.5, view.keypoint_landmark[gap.argmin(1)], -1)
    x_other, x_known = other.landmarks[points.landmark], known.landmarks[label]
    sound = (label >= 0) & ~known.candidate[label] & np.isfinite(x_known).all(1) & np.isfinite(x_other).all(1)
    if np.count_nonzero(sound) < _FEWEST_PAIRS:
        return None
    x_other, x_known = x_other[sound], x_known[sound]
    R = pose_arrays(pose)[0].T @ pose_arrays(view.pose)[0]
    centre_other, centre_known = np.median(x_other, 0), np.median(x_known, 0)
    spread_other = np.median(np.linalg.norm(x_other - centre_other, axis=1))
    scale = float(spread_other / max(np.median(np.linalg.norm(x_known - centre_known, axis=1)), 1e-9))
    return Similarity(R, scale, np.median(x_other - scale * x_known @ R.T, 0))


def _as_one(
    state: Belief, other: ObjectMap, similarity: Similarity, config: OnlineConfig
) -> ObjectMap | None:
    """Both maps as one, where that explains their keyframes nearly as well as two do."""
    camera, second = state.camera, moved(state.known, similarity)
    pairs = same_landmarks(other, second, camera)
    if len(pairs) < _FEWEST_PAIRS:
        return None
    most = max(config.most_keyframes, len(other.keyframes))
    known = united(other, second, pairs, most)
    everything = list(range(len(known.keyframes)))
    known = refined(known, camera, everything, config, bundle_iterations=20, rounds=3)
    alone = max(keyframe_cost(other), keyframe_cost(state.known))
    return known if keyframe_cost(known) < _WORSE * alone else None


def _with_joined(state: Belief, other: Aside, similarity: Similarity, known: ObjectMap) -> Belief:
    newest = known.keyframes[-1]
    at_newest = newest.index == state.last[1]
    last = newest.pose if at_newest else moved_pose(state.last[0], similarity)
    points = newest.points.spread(MOST_FOLLOWED, float(newest.observation.window.side))
    before = state.before
    usual = other.usual if other.usual.frames > state.usual.frames else state.usual
    return replace(
        state,
        known=known,
        surface=known.surface(),
        last=(last, state.last[1]),
        before=before and (moved_pose(before[0], similarity), before[1]),
        trail=tuple((moved_pose(pose, similarity), index) for pose, index in state.trail),
        followed=points if at_newest else FollowedPoints.none(),
        usual=usual if usual.frames else Usual(),
        past=(),
        aside=tuple(one for one in state.aside if one is not other),
        spans=(*state.spans, *other.spans),
        guessed=state.guessed and other.guessed,
        reversal_tried=(0, 0.0),
    )
