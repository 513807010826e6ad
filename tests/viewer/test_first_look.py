"""What the 3D view shows at first: the object, as its cameras saw it, and frusta that do not hide it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from recorded_runs import model

from tracking3d.results import drawing
from tracking3d.results.overlay import ObjectAxes
from tracking3d.ui.viewer.first_look import (
    ASPECT,
    FOV,
    NARROW,
    aside_of,
    corners_of,
    fainten,
    frame_object,
    frustum_size,
    object_box,
    radius_of,
    stack_objects,
)

RING = np.array([[np.sin(turn), 0, -np.cos(turn)] for turn in np.linspace(0, 6, 40)]) * 4
BOXES = {"cube": (1, 1, 1), "tower": (0.3, 1.5, 0.3), "plank": (1.5, 0.1, 0.4)}


def view_of(places: np.ndarray, aspect: float, aside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where in the view places are: 1 at its edge, ``(N, 2)``; and their depths ``(N,)``."""
    middle, distance = frame_object(places, aside, aspect)
    right = np.cross(-aside, [0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    seen = places - (middle + distance * aside)
    depth, half = seen @ -aside, np.tan(FOV / 2)
    upright = seen @ np.cross(-aside, right)
    return np.abs(np.stack([seen @ right / (half * aspect), upright / half], 1)) / depth[:, None], depth


@pytest.mark.parametrize("sides", BOXES.values(), ids=BOXES)
@pytest.mark.parametrize("aspect", [ASPECT, NARROW], ids=["one", "several_videos"])
@pytest.mark.parametrize("path", [RING, RING[:14], RING[:1]], ids=["ring", "arc", "one"])
def test_the_object_fills_the_view_and_no_part_of_it_is_outside(sides, aspect, path):
    corners = corners_of(np.array([-1.0, 1.0])[:, None] * sides + [0.3, 0, 0])
    assert corners.shape == (8, 3)
    seen, depth = view_of(corners, aspect, aside_of(path))
    assert (depth > 0).all()
    assert 0.6 < seen.max() < 1


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 0, 2), (0, 2, 1)], ids=["level", "upright", "facing"])
def test_it_is_seen_from_where_the_first_camera_was_but_from_aside_if_cameras_are_all_around(axes):
    path = RING[:, axes]
    aside = aside_of(path)
    assert 0.8 < aside @ path[0] / np.linalg.norm(path[0]) < 0.95
    normal = np.linalg.svd(path - path.mean(0))[2][2]
    assert abs(normal @ aside) > 0.2, "not flat onto the path"


def test_it_is_seen_from_the_middle_of_an_arc_of_cameras_and_from_above():
    aside = aside_of(RING[:14])
    middle = RING[:14].mean(0)
    assert 0.8 < aside @ middle / np.linalg.norm(middle) < 0.95
    assert aside[1] < -0.2, "y points down"


@pytest.mark.parametrize(
    "path", [RING[:1], RING[:3], np.array([[0.0, -4.0, 0.0]]), np.array([[0.0, 4.0, 0.0]])]
)
def test_a_path_of_next_to_no_length_is_looked_at_from_aside(path):
    aside = aside_of(path)
    assert np.linalg.norm(aside) == pytest.approx(1)
    assert 0.8 < aside @ path[0] / np.linalg.norm(path[0]) < 0.95


def test_a_long_path_takes_no_more_than_its_own_room():
    turns = np.linspace(0, 6, 100_000)  # a square matrix of that side has 80 GB
    path = 4 * np.stack([np.sin(turns), 0 * turns, -np.cos(turns)], axis=1)
    assert aside_of(path) == pytest.approx(aside_of(RING), abs=0.05)


def test_the_object_is_where_its_mesh_is_or_else_where_a_mask_shows_it():
    mesh = SimpleNamespace(vertices=model().vertices + np.array([2.0, 0, 0]))
    assert np.allclose(object_box(mesh, None, 4.0).mean(0), [2, 0, 0], atol=0.02)
    assert radius_of(object_box(mesh, None, 4.0)) == pytest.approx(3**0.5, rel=0.05)
    axes = ObjectAxes(np.array([0.5, 0, 0]), 0.2)
    assert np.allclose(object_box(None, axes, 4.0), [[0.3, -0.2, -0.2], [0.7, 0.2, 0.2]])
    assert 0 < radius_of(object_box(None, None, 4.0)) < 2


@pytest.mark.parametrize("distance", [1.5, 4.0, 13.0, 100.0])
def test_frusta_are_small_beside_the_object_and_do_not_reach_it(distance):
    size = frustum_size(1.0, distance)
    assert 0.05 < size <= 0.15
    assert size < 0.1 * distance


def test_their_colours_are_faint_but_can_be_told_apart():
    shown = [fainten(colour) for colour in (*drawing.STATUS.values(), drawing.KEYFRAME)]
    assert max(max(colour) for colour in shown) < 140
    apart = [np.abs(np.subtract(a, b)).max() for n, a in enumerate(shown) for b in shown[:n]]
    assert min(apart) >= 8
    assert min(max(colour) for colour in shown) > 80  # the background is black


def test_objects_stand_below_one_another_without_touching():
    radii = [1.0, 0.2, 3.0]
    places = stack_objects(radii)
    assert places[0] == 0
    for n in (1, 2):
        assert places[n] - places[n - 1] > radii[n] + radii[n - 1]
    assert stack_objects([2.0]) == [0.0] and stack_objects([]) == []
