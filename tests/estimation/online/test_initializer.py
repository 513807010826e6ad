"""The first frames wait until they can be solved together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from patterns import disc, moved, shift, speckle, warped
from solid_points import map_with_points
from turned_solid import CAMERA, SIZE, turned, turned_map

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.feature_space import FeatureSpace
from tracking3d.estimation.online import initializer
from tracking3d.estimation.online.features.klt import MOST_POINTS, FollowedPoints, follow
from tracking3d.estimation.online.initialization import pending_frames
from tracking3d.estimation.online.initialization.initial_map import InitialMap
from tracking3d.estimation.online.initialization.pending_frames import (
    add_pending_frame,
    try_initialize,
    why_no_map,
)
from tracking3d.estimation.online.masks import initial_estimate
from tracking3d.estimation.online.state.solver_state import Initializing, Mapped
from tracking3d.frames import Frame

CONFIG = OnlineConfig()
STEADY = [0.0, 6.0, 12.0, 18.0, 24.0, 30.0]
STILL = [0.0] * 6


@pytest.fixture
def asked(monkeypatch):
    """Which views a start was asked for, by kind; what it costs can be set."""
    calls: dict = {"points": [], "turning": [], "bundle": 0.05}

    def solve_start(object_map, cameras, views, weights, prior):
        calls["points"].append(len(views))
        return (
            [InitialMap(object_map, 1.0, calls["bundle"], "points", cameras[0])]
            if calls["bundle"] is not None
            else []
        )

    def by_turning(object_map, camera, views, weights):
        calls["turning"].append(len(views))
        return [InitialMap(object_map, 0.5, 0.0, "turning", camera)]

    monkeypatch.setattr(pending_frames, "solve_start", solve_start)
    monkeypatch.setattr(pending_frames, "initialize_without_points", by_turning)
    return calls


def belief_of(angles, without_mask=()) -> Initializing:
    """Frames of the turned solid that wait."""
    object_map = map_with_points(angles)
    held = []
    for view in object_map.keyframes:
        frame = Frame(view.index, np.zeros((SIZE, SIZE, 3), np.uint8))
        if view.index // 2 in without_mask:
            view = replace(view, mask=None)
        held.append((view, initial_estimate(frame, view.mask, view.pose, CAMERA)))
    nothing = replace(object_map, keyframes=())
    grey = np.zeros((SIZE, SIZE), np.uint8)
    last, points = (turned(0), 0), FollowedPoints.none()
    return Initializing(CAMERA, nothing, last, grey, points, pending=tuple(held))


def test_an_object_that_turns_is_solved(asked):
    state, start = try_initialize(belief_of(STEADY), CONFIG)
    assert start is not None
    assert start.origin == "points"
    assert asked["points"] == [6]
    assert not asked["turning"]
    assert state.waiting_reason == ""


def test_without_motion_nothing_is_tried(asked):
    given = belief_of(STILL)
    state, start = try_initialize(given, CONFIG)
    assert start is None
    assert state is given
    assert not asked["points"]


def strangers(state: Initializing) -> Initializing:
    """No point of a frame is found in another one."""
    held = []
    for number, (view, estimate) in enumerate(state.pending):
        points = FollowedPoints(view.points.landmark + 1000 * number, view.points.pixel)
        held.append((replace(view, points=points, strength=1.0), estimate))
    return replace(state, pending=tuple(held))


@pytest.mark.parametrize(
    ("state", "reason"),
    [
        (belief_of(STEADY[:3]), "a first map takes 4 frames that show the object, and there are 3"),
        (replace(belief_of(STILL), pending=()), "and there are 0"),
        (
            strangers(belief_of(STEADY)),
            "the views are too far apart: 0 % of the points of one are found again",
        ),
        (belief_of(STILL), "nothing shows that the object turns"),
        (replace(belief_of(STILL), waiting_reason="the object has not moved yet"), "has not moved yet"),
    ],
    ids=["few", "none", "far apart", "still", "at rest"],
)
def test_a_video_that_ends_without_a_map_says_what_was_found(state, reason):
    assert reason in why_no_map(state)


def test_fewer_than_four_masks_are_too_few_however_it_moves(asked):
    assert try_initialize(belief_of(STEADY[:3]), CONFIG)[1] is None
    assert try_initialize(belief_of(STEADY, without_mask=(1, 2, 4)), CONFIG)[1] is None
    assert not asked["points"]


def test_frames_without_a_mask_are_not_solved_with_the_others(asked):
    assert try_initialize(belief_of(STEADY, without_mask=(2,)), CONFIG)[1] is not None
    assert asked["points"] == [5]


def test_a_doubtful_start_is_tried_again_only_after_more_motion(asked):
    asked["bundle"] = 0.6
    state, start = try_initialize(belief_of(STEADY), CONFIG)
    assert start is None
    assert asked["points"] == [6]
    again, start = try_initialize(state, CONFIG)
    assert start is None
    assert again is state
    assert asked["points"] == [6]
    asked["bundle"] = 0.05
    further = replace(belief_of([2 * angle for angle in STEADY]), next_attempt=state.next_attempt)
    assert try_initialize(further, CONFIG)[1] is not None


def test_candidates_do_not_show_motion(asked):
    given = belief_of(STEADY)
    object_map = replace(given.object_map, candidate=np.ones(len(given.object_map.landmarks), bool))
    assert try_initialize(replace(given, object_map=object_map), CONFIG)[1] is None
    assert not asked["points"]


def test_points_that_do_not_tell_give_way_to_turning_at_last(asked):
    asked["bundle"] = None
    _, start = try_initialize(belief_of(list(np.linspace(0, 60, 41))), CONFIG)
    assert start is not None
    assert start.origin == "turning"
    assert asked["turning"] == [41]


def test_what_is_still_for_long_keeps_waiting_with_fewer_frames_and_says_why(asked):
    state, start = try_initialize(belief_of([0.0] * 41), CONFIG)
    assert start is None
    assert state.waiting_reason == "the object has not moved yet"
    indices = [view.index for view, _ in state.pending]
    assert len(indices) == 21
    assert (indices[0], indices[-1]) == (0, 80)
    assert indices == sorted(set(indices))
    assert not asked["turning"]


NUDGE = [0.0] * 6 + [11.0, 15.0]  # degrees


@pytest.mark.parametrize(
    ("angles", "started_at_rest", "ended", "started"),
    [
        (NUDGE, False, False, True),
        (NUDGE, True, False, False),
        (NUDGE, True, True, True),
        ([*NUDGE, 24.0], True, False, True),
    ],
)
def test_a_nudge_starts_no_object_that_rested_until_then(asked, angles, started_at_rest, ended, started):
    given = belief_of(angles)
    given = replace(given, object_map=replace(given.object_map, started_at_rest=started_at_rest))
    assert (try_initialize(given, CONFIG, ended=ended)[1] is not None) is started
    assert bool(asked["points"]) is started


def test_an_object_that_was_still_for_long_rests_and_one_that_has_gone_does_not(asked):
    state, _ = try_initialize(belief_of([0.0] * 41), CONFIG)
    assert state.object_map.started_at_rest
    state, _ = try_initialize(belief_of(STILL), CONFIG)
    assert not state.object_map.started_at_rest


def test_points_that_stand_still_refute_a_rotation_whatever_else_changes(asked, monkeypatch):
    """A hand that comes, or light, changes the pixels of a thing that stands on a table."""
    monkeypatch.setattr(pending_frames, "_last_still_view", lambda views: 0)
    _, start = try_initialize(belief_of([0.0] * 41), CONFIG)
    assert start is None
    assert not asked["turning"]


def test_points_that_are_gone_without_having_moved_tell_no_shape(asked):
    """From where the object is seen with points again, the wait begins again."""
    given = belief_of([0.0] * 14)
    kept = [
        (replace(view, points=view.points.only(view.points.landmark < 2)), estimate)
        if place >= 11
        else (view, estimate)
        for place, (view, estimate) in enumerate(given.pending)
    ]
    state, start = try_initialize(replace(given, pending=tuple(kept)), CONFIG)
    assert start is None
    assert not asked["points"]
    assert not asked["turning"]
    assert state.waiting_reason == "the object has not moved yet"
    assert [view.index for view, _ in state.pending] == [22, 24, 26]


IMAGE, MASK = speckle(), disc((200, 240), (110, 100), 60)
MOTION = shift(3.0, -2.0)


@pytest.fixture(scope="module")
def first():
    view = replace(turned_map([0.0]).keyframes[0], mask=MASK)
    return add_pending_frame(turned_map([0.0]), (), view, IMAGE)


def test_the_first_view_gets_points_inside_its_mask_whose_depth_is_unknown(first):
    object_map, view = first
    assert len(view.points) > 0.6 * MOST_POINTS
    assert len(object_map.landmarks) == len(object_map.candidate) == len(np.unique(view.points.landmark))
    assert np.isnan(object_map.landmarks).all()
    assert not object_map.candidate.any()
    x, y = np.rint(view.points.pixel).astype(int).T
    assert MASK[y, x].mean() > 0.98


def test_a_view_with_points_enough_stays_as_it_is(first):
    object_map, view = first
    now = warped(IMAGE, MOTION)
    later = replace(view, points=follow(IMAGE, now, view.points))
    again, same = add_pending_frame(object_map, (view,), later, now)
    assert again is object_map
    assert same.points is later.points
    assert same.keypoints is later.keypoints


def test_points_that_were_lost_are_found_again_by_name(first):
    object_map, view = first
    now = warped(IMAGE, MOTION)
    bare = replace(view, mask=warped(MASK.astype(np.uint8), MOTION) > 0, points=FollowedPoints.none())
    more, found = add_pending_frame(object_map, (view,), bare, now)
    old = found.points.landmark < len(object_map.landmarks)
    assert old.sum() > 50
    place = dict(zip(view.points.landmark.tolist(), view.points.pixel, strict=True))
    before = np.array([place[name] for name in found.points.landmark[old]])
    gap = np.linalg.norm(found.points.pixel[old] - moved(before, MOTION), axis=1)
    assert np.median(gap) < 0.3
    assert (gap < 1.5).mean() > 0.95
    assert len(more.landmarks) == len(object_map.landmarks) + (~old).sum()


def test_names_are_unique_and_followed_points_keep_theirs(first):
    object_map, view = first
    now = warped(IMAGE, MOTION)
    followed = follow(IMAGE, now, view.points.only(np.arange(len(view.points)) < 40))
    bare = replace(view, mask=warped(MASK.astype(np.uint8), MOTION) > 0, points=followed)
    _, found = add_pending_frame(object_map, (view,), bare, now)
    assert len(np.unique(found.points.landmark)) == len(found.points)
    np.testing.assert_array_equal(found.points.landmark[: len(followed)], followed.landmark)
    np.testing.assert_array_equal(found.points.pixel[: len(followed)], followed.pixel)


def test_points_that_run_wild_give_way_to_turning_without_more_motion(asked):
    """They show as much change of form as half a turn and fit no start: waiting for more of it is in vain."""
    asked["bundle"] = 0.6
    given = belief_of(list(np.linspace(0, 80, 15)))
    assert try_initialize(replace(given, pending=given.pending[:12]), CONFIG)[1] is None
    _, start = try_initialize(replace(given, next_attempt=9.0), CONFIG)
    assert start is not None and start.origin == "turning"
    assert asked["turning"] == [15]


def test_a_plain_object_is_started_without_points_once_it_had_time_to_turn(asked):
    given = belief_of(list(np.linspace(0, 60, 13)))
    plain = [(replace(view, strength=0.1), estimate) for view, estimate in given.pending]
    early = replace(given, pending=tuple(plain[:12]))
    assert try_initialize(early, CONFIG) == (early, None)
    _, start = try_initialize(replace(given, pending=tuple(plain)), CONFIG)
    assert start is not None and start.origin == "turning"
    assert not asked["points"]


def test_a_second_map_is_given_up_where_only_one_without_points_can_be_made(asked):
    given = replace(belief_of(list(np.linspace(0, 60, 13))), needs_points=True)
    plain = tuple((replace(view, strength=0.1), estimate) for view, estimate in given.pending)
    state, start = try_initialize(replace(given, pending=plain), CONFIG)
    assert start is None and not state.pending
    asked["bundle"] = 0.6  # points that move, but not with one rigid object
    state, start = try_initialize(given, CONFIG, ended=True)
    assert start is None and not state.pending
    assert not asked["turning"]


def test_a_start_without_points_sees_the_contrast_of_small_marks(monkeypatch):
    given = belief_of(list(np.linspace(0, 60, 13)))
    plain = tuple((replace(view, strength=0.1), estimate) for view, estimate in given.pending)
    channels = len(plain[0][0].observation.features)
    space = FeatureSpace(torch.zeros(channels), torch.eye(channels))
    seen = []

    def start(object_map, camera, views, weights):
        seen.extend(len(view.observation.features) for view in views)
        return [InitialMap(object_map, 0.1, 0.0, "turning", camera)]

    monkeypatch.setattr(pending_frames, "initialize_without_points", start)
    try_initialize(replace(given, pending=plain, feature_space=space), CONFIG)
    assert set(seen) == {channels + 1}


def test_a_map_without_points_that_misses_its_masks_is_not_accepted(asked, monkeypatch):
    given = belief_of(list(np.linspace(0, 60, 13)))
    plain = tuple((replace(view, strength=0.1), estimate) for view, estimate in given.pending)

    def missing(object_map, camera, views, weights):
        return [InitialMap(object_map, 0.1, 0.0, "turning", camera, overlap=0.6)]

    monkeypatch.setattr(pending_frames, "initialize_without_points", missing)
    state, start = try_initialize(replace(given, pending=plain), CONFIG)
    assert start is None
    assert "masks" in state.waiting_reason
    # Later frames get another chance; those before them still get a pose in the end.
    assert len(state.pending) == 8
    assert [*state.rested, *state.pending] == list(plain)


def test_starts_from_points_stay_if_the_map_without_points_misses_its_masks(asked, monkeypatch):
    asked["bundle"] = 0.6
    given = belief_of(list(np.linspace(0, 60, 13)))

    def missing(object_map, camera, views, weights):
        return [InitialMap(object_map, 0.1, 0.0, "turning", camera, overlap=0.6)]

    monkeypatch.setattr(pending_frames, "initialize_without_points", missing)
    _, start = try_initialize(given, CONFIG, ended=True)
    assert start is not None and start.origin == "points"


def test_a_map_that_explains_frames_badly_for_long_is_begun_again_twice_at_most(monkeypatch):
    object_map = replace(turned_map([0.0, 10.0, 20.0]), pointless=True)
    better = replace(object_map, keyframes=object_map.keyframes[:2])
    monkeypatch.setattr(initializer, "restart_without_points", lambda *_: better)
    last, points = (turned(0), 0), FollowedPoints.none()
    state = Mapped(
        CAMERA, object_map, last, np.zeros((SIZE, SIZE), np.uint8), points,
        surface=object_map.surface(), misfits=4, lost_frames=2, doubtful_frames=15,
    )  # fmt: skip
    assert initializer.restart_if_misfit(state, CONFIG) is state
    state = initializer.restart_if_misfit(replace(state, misfits=5), CONFIG)
    assert state.object_map is better
    assert state.last_pose == (better.keyframes[-1].pose, better.keyframes[-1].index)
    assert (state.misfits, state.lost_frames, state.restarts) == (0, 0, 1)
    assert state.doubtful_frames == 15, "a map with points is not waited for from the start again"
    state = initializer.restart_if_misfit(replace(state, misfits=5, object_map=object_map), CONFIG)
    assert state.object_map is better
    last = replace(state, misfits=9, object_map=object_map)
    assert initializer.restart_if_misfit(last, CONFIG) is last


def test_one_frame_that_looks_plain_or_printed_does_not_decide(asked):
    given = belief_of(STEADY)
    first, *others = given.pending
    mixed = ((replace(first[0], strength=0.1), first[1]), *others)
    assert try_initialize(replace(given, pending=mixed), CONFIG)[1].origin == "points"


def test_an_object_that_has_left_is_solved_with_what_was_seen_of_it(asked):
    asked["bundle"] = 0.6
    given = belief_of([*STEADY, 30.0, 30.0, 30.0])
    slip = replace(given, pending=hidden(given.pending[:7], 1))
    assert try_initialize(slip, CONFIG)[1] is None
    assert try_initialize(replace(given, pending=hidden(given.pending, 3)), CONFIG)[1].origin == "turning"


def hidden(waiting, last: int):
    return (*waiting[:-last], *((replace(view, mask=None), estimate) for view, estimate in waiting[-last:]))


@pytest.mark.parametrize(
    ("degrees", "cost", "decided"),
    [(-1.0, 1.05, False), (-1.0, 3.0, True), (1.6, 1.05, True)],
    ids=["reversed", "reversed but costly", "further about the same axis"],
)
def test_a_start_waits_while_another_that_turns_otherwise_costs_hardly_more(
    monkeypatch, degrees, cost, decided
):
    def solve_start(object_map, cameras, views, weights, prior):
        return [
            InitialMap(
                replace(object_map, keyframes=turned_views(views, sign)), price, 0.05, "points", cameras[0]
            )
            for sign, price in ((1.0, 1.0), (degrees, cost))
        ]

    def turned_views(views, sign):
        return tuple(replace(view, pose=turned(sign * 2.0 * place)) for place, view in enumerate(views))

    monkeypatch.setattr(pending_frames, "solve_start", solve_start)
    state, start = try_initialize(belief_of([0.0, 3.0, 6.0, 9.0, 12.0]), CONFIG)
    assert (start is not None) is decided
    assert ("two ways" in state.waiting_reason) is not decided


def test_points_do_not_stay_where_an_object_was_that_has_left(first):
    object_map, view = first
    away = replace(view, mask=None)
    _, slipped = add_pending_frame(object_map, (view,), away, IMAGE)
    assert len(slipped.points) == len(view.points)
    _, gone = add_pending_frame(object_map, (view, away, away), away, IMAGE)
    assert len(gone.points) == 0


def test_points_that_are_followed_badly_decide_at_once(asked, monkeypatch):
    asked["bundle"] = 0.4
    monkeypatch.setattr(pending_frames, "_same_axis", lambda one, other: False)
    turning = map_with_points(STEADY)
    one = pending_frames.solve_start(turning, [CAMERA], [], None, 0.0)[0]
    assert not pending_frames._is_undecided([one, one], 0.04, None)
    assert pending_frames._is_undecided([replace(one, bundle=0.1), one], 0.04, None)


def test_where_points_get_worse_the_start_of_before_is_taken_up_again(monkeypatch):
    asked = []

    def solve_start(object_map, cameras, views, weights, prior):
        asked.append(len(views))
        bundle = 0.1 if len(views) < 6 else 0.4
        object_map = map_with_points(STEADY)
        return [InitialMap(object_map, 1.0, bundle, str(len(views)), cameras[0])] * 2

    monkeypatch.setattr(pending_frames, "solve_start", solve_start)
    monkeypatch.setattr(pending_frames, "_same_axis", lambda one, other: False)
    given = belief_of(STEADY)
    state, start = try_initialize(replace(given, pending=given.pending[:5]), CONFIG)
    assert start is None
    assert state.ambiguous_frames == 5
    _, start = try_initialize(replace(state, pending=given.pending, next_attempt=0.0), CONFIG)
    assert start is not None and start.origin == "5"
    assert asked == [5, 6, 5]


def test_when_no_more_frames_come_the_better_start_is_taken(monkeypatch):
    object_map = map_with_points(STEADY)
    monkeypatch.setattr(
        pending_frames, "solve_start", lambda *given: [InitialMap(object_map, 1.0, 0.1, "points", CAMERA)] * 2
    )
    monkeypatch.setattr(pending_frames, "_same_axis", lambda one, other: False)
    state, start = try_initialize(belief_of(STEADY), CONFIG)
    assert start is None
    assert try_initialize(state, CONFIG, ended=True)[1].origin == "points"
