"""Where a browser looks from at first."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is absent: pip install 'tracking3d[view]'")

from tracking3d.viewer.browser_camera import _ASPECT, _FOV, _NARROW, aside_of, frame_object

RING = np.array([[np.sin(turn), 0, -np.cos(turn)] for turn in np.linspace(0, 6, 40)]) * 4


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 0, 2), (0, 2, 1)], ids=["level", "upright", "facing"])
def test_the_first_look_is_onto_the_plane_of_the_path_and_not_along_it(axes):
    path = RING[:, axes]
    aside = aside_of(path)
    normal = np.abs(np.linalg.svd(path - path.mean(0))[2][2] @ aside)
    assert 0.7 < normal < 0.99, "onto it, but not flat"
    assert aside[1] < -0.1, "from above, for y points down"


@pytest.mark.parametrize("path", [RING[:1], RING[:3]], ids=["one", "short"])
def test_a_path_of_next_to_no_length_is_looked_at_from_aside(path):
    aside = aside_of(path)
    assert np.isfinite(aside).all()
    assert 0.5 < aside @ path[0] / np.linalg.norm(path[0]) < 0.9, (
        "as the camera saw it, but not through the camera"
    )


def test_a_long_path_takes_no_more_than_its_own_room():
    turns = np.linspace(0, 6, 100_000)  # a square matrix of that side has 80 GB
    path = 4 * np.stack([np.sin(turns), 0 * turns, -np.cos(turns)], axis=1)
    assert aside_of(path) == pytest.approx(aside_of(RING), abs=0.05)


def test_an_arc_is_seen_from_behind_its_cameras():
    assert aside_of(RING[:14]) @ RING[7] > 0.5 * np.linalg.norm(RING[7])


@pytest.mark.parametrize("path", [RING, RING[:14], RING[:1]], ids=["ring", "arc", "one"])
@pytest.mark.parametrize("aspect", [_ASPECT, _NARROW], ids=["one", "beside_one_another"])
def test_the_first_look_holds_the_path_and_the_object(path, aspect):
    places, aside = np.vstack([path, np.zeros(3)]), aside_of(path)
    middle, distance = frame_object(places, aside, aspect)
    forward = -aside
    right = np.cross(forward, [0.0, -1.0, 0.0])
    right /= np.linalg.norm(right)
    seen = places - (middle + distance * aside)
    depth = seen @ forward
    half = np.tan(_FOV / 2)
    assert (depth > 0).all()
    assert (np.abs(seen @ right / depth) < half * aspect).all()
    assert (np.abs(seen @ np.cross(forward, right) / depth) < half).all()
