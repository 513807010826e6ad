"""Points beside the mask are taken over where they move with the object, and dropped where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from patterns import disc, speckle
from solid_points import pixels_of
from turned_solid import CAMERA, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping import keyframe_insertion
from tracking3d.estimation.online.mapping.keyframe_insertion import (
    MOST_CANDIDATES,
    is_static_scene,
    promote_candidates,
    surroundings,
    with_candidates,
)
from tracking3d.estimation.online.mapping.local_mapping import shared_landmarks

ANGLES = [-15.0, -5.0, 5.0, 15.0]
POINT = np.array([0.1, 0.1, -0.75])
"""A little before the surface, on its near side in all views."""


def with_tracks(*tracks, angles=ANGLES):
    """The solid, and candidates with these pixels in its views; None where a view does not show one."""
    object_map = turned_map(angles)
    views = []
    for number, view in enumerate(object_map.keyframes):
        names = [n for n, track in enumerate(tracks) if track[number] is not None]
        pixels = np.array([tracks[n][number] for n in names], np.float32).reshape(-1, 2)
        views.append(replace(view, points=FollowedPoints(np.array(names, np.int64), pixels)))
    return replace(
        object_map,
        keyframes=tuple(views),
        landmarks=np.full((len(tracks), 3), np.nan),
        candidate=np.ones(len(tracks), bool),
    )


SMALL = [-5.0, -1.0, 3.0, 6.0]  # degrees


def rigid(angles=ANGLES):
    return [pixels_of(POINT[None], view)[0] for view in turned_map(angles).keyframes]


def recruited(object_map):
    return promote_candidates(object_map, CAMERA, list(range(len(object_map.keyframes))))


def shown(object_map):
    """Names that any keyframe still shows."""
    return set(np.concatenate([view.points.landmark for view in object_map.keyframes]).tolist())


def test_a_point_that_moves_with_the_object_becomes_a_landmark_where_it_is():
    object_map = recruited(with_tracks(rigid()))
    assert object_map.candidate.tolist() == [False]
    np.testing.assert_allclose(object_map.landmarks[0], POINT, atol=0.02)
    assert shown(object_map) == {0}


def test_a_point_of_the_background_is_dropped():
    turns = [-40.0, -15.0, 15.0, 40.0]
    beside = [[57.0, 34.0]] * 4
    object_map = recruited(with_tracks(beside, rigid(turns), angles=turns))
    assert shown(object_map) == {1}
    assert object_map.candidate.tolist() == [True, False]


def test_a_point_that_moves_otherwise_is_dropped():
    across = [[20.0, 20.0], [26.0, 38.0], [21.0, 28.0], [40.0, 25.0]]
    assert shown(recruited(with_tracks(across, rigid()))) == {1}


def test_what_two_views_show_waits():
    track = [rigid()[0], None, None, rigid()[3]]
    object_map = recruited(with_tracks(track))
    assert object_map.candidate.tolist() == [True]
    assert shown(object_map) == {0}


def test_while_nothing_moves_nothing_is_told():
    angles = [0.0, 0.2, 0.4, 0.6]
    object_map = recruited(with_tracks(rigid(angles), [[50.0, 30.0]] * 4, angles=angles))
    assert object_map.candidate.tolist() == [True, True]
    assert shown(object_map) == {0, 1}


def test_what_six_views_cannot_tell_is_dropped():
    angles = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert not shown(recruited(with_tracks(rigid(angles), angles=angles)))


def test_a_point_far_from_the_object_is_none_of_it():
    # It turns with the object, at three times its radius.
    far = np.array([0.4, 0.2, -2.4])
    track = [pixels_of(far[None], view)[0] for view in turned_map(ANGLES).keyframes]
    assert not shown(recruited(with_tracks(track)))


def test_a_point_without_any_residual_is_dropped_without_a_warning(monkeypatch):
    adjust = keyframe_insertion.adjust

    def behind(*arguments, **settings):
        found = adjust(*arguments, **settings)
        return replace(found, residual=np.full_like(found.residual, np.nan))

    monkeypatch.setattr(keyframe_insertion, "adjust", behind)
    assert not shown(recruited(with_tracks(rigid())))


def test_landmarks_are_not_asked():
    object_map = with_tracks([[30.0, 30.0]] * 4)
    object_map = replace(object_map, landmarks=POINT[None], candidate=np.zeros(1, bool))
    assert recruited(object_map) is object_map


MASK = disc((200, 240), (120, 100), 40)


def test_the_surroundings_are_a_band_around_the_mask():
    band = surroundings(MASK)
    assert not (band & MASK).any()
    reach = 0.25 * np.sqrt(MASK.sum())
    assert band[100, 120 + 42]
    assert band[100, int(120 + 40 + reach - 2)]
    assert not band[100, int(120 + 40 + reach + 3)]


@pytest.mark.parametrize("masked", [True, False])
def test_candidates_are_corners_beside_the_mask_at_no_known_place(masked):
    object_map = turned_map([0.0])
    view = replace(object_map.keyframes[0], mask=MASK if masked else None)
    more, shows = with_candidates(object_map, view, speckle())
    if not masked:
        assert len(more.landmarks) == len(shows.points) == 0
        return
    assert 10 < len(shows.points) <= MOST_CANDIDATES
    assert more.candidate.all()
    assert np.isnan(more.landmarks).all()
    x, y = np.rint(shows.points.pixel).astype(int).T
    # A corner is refined by up to two pixels.
    assert surroundings(MASK)[y, x].mean() > 0.9
    # The room for candidates is filled once.
    again, _ = with_candidates(more, shows, speckle())
    assert len(again.landmarks) <= MOST_CANDIDATES


def test_next_to_an_object_that_rested_a_point_is_promoted_only_after_it_has_turned(monkeypatch):
    """On a table everything moves in the image as the object does, while a hand holds the camera."""
    monkeypatch.setattr(keyframe_insertion, "_MIN_MOTION", 2.0)  # pixels
    little, much = (
        replace(with_tracks(rigid(angles), angles=angles), started_at_rest=True) for angles in (SMALL, ANGLES)
    )
    assert not recruited(replace(little, started_at_rest=False)).candidate.any()
    undecided = recruited(little)
    assert undecided.candidate.all()
    assert shown(undecided) == {0}  # it is not dropped: later frames decide
    assert not recruited(much).candidate.any()


def ring(directions) -> list:
    """Tracks of points before the solid in these directions from its middle, four in each, that move as it does."""
    angles = np.repeat(np.deg2rad(directions), 4) + np.tile(np.deg2rad([-6, -2, 2, 6]), len(directions))
    points = np.column_stack([0.85 * np.cos(angles), 0.85 * np.sin(angles), np.full(len(angles), -0.75)])
    return [[pixels_of(point[None], view)[0] for view in turned_map(ANGLES).keyframes] for point in points]


def test_where_everything_around_moves_with_the_object_the_scene_is_a_still_one_and_nobody_is_recruited():
    tracks = ring([22.5 + 45 * n for n in range(8)])
    object_map = recruited(with_tracks(*tracks))
    assert is_static_scene(object_map.candidates_around)
    assert object_map.candidate.all()
    # They tell how the camera moves, and nothing of the object.
    assert np.isfinite(object_map.landmarks).all()
    assert not len(shared_landmarks(object_map, list(object_map.keyframes)))


def test_what_moves_otherwise_in_a_still_scene_is_dropped():
    across = [[20.0, 20.0], [26.0, 38.0], [21.0, 28.0], [40.0, 25.0]]
    object_map = recruited(with_tracks(*ring([22.5 + 45 * n for n in range(8)]), across))
    assert is_static_scene(object_map.candidates_around)
    assert shown(object_map) == set(range(32))


def test_what_moves_with_the_object_on_some_sides_is_part_of_it():
    object_map = recruited(with_tracks(*ring([22.5, 67.5, 112.5])))
    assert not is_static_scene(object_map.candidates_around)
    assert not object_map.candidate.any()


@pytest.mark.parametrize(
    ("told", "fit", "expected"),
    [
        ([9] * 8, [9] * 8, True),
        ([9] * 8, [9, 9, 9, 9, 9, 9, 0, 0], True),
        ([9] * 8, [9, 9, 9, 9, 0, 0, 0, 0], False),
        ([9] * 8, [5] * 8, False),
        ([9, 9, 9, 9, 0, 0, 0, 0], [9, 9, 9, 9, 0, 0, 0, 0], False),
        ([2] * 8, [2] * 8, False),
        ([0] * 8, [0] * 8, False),
    ],
)
def test_a_still_scene_needs_most_directions(told, fit, expected):
    assert is_static_scene(np.array([told, fit]).T) is expected
