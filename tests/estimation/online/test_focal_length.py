"""A lens that was only assumed is solved where the points tell clearly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tracked_solids import SIZE, degrees_between, scene
from turned_solid import turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping import focal_length
from tracking3d.estimation.online.mapping.focal_length import solve_lens
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays, pose_from_arrays
from tracking3d.points.bundle_adjustment.adjustment import Structure, adjust


def solved_with(
    camera: Camera, truth: Camera, fov: float, count: int = 80, turn: float = 70.0, noise: float = 0.2
):
    """A map of a solid that was tracked through one lens and solved with another; and the true poses."""
    given = scene(8, count, fov=fov, turn=turn, noise=noise)
    stretch = [1.0, 1.0, camera.fy / truth.fy]
    start = Structure(given.truth.R, given.truth.t * stretch, given.truth.points)
    solved = adjust(given.tracks, camera.K, start, iterations=40)
    base = turned_map([0.0])
    view = base.keyframes[0]
    K = torch.tensor(view.observation.window.K(camera)).float()
    keyframes = []
    for n in range(8):
        names = np.flatnonzero(given.tracks.visible[n])
        keyframes.append(
            replace(
                view,
                observation=replace(view.observation, index=n, K=K),
                pose=pose_from_arrays(solved.R[n], solved.t[n], base.vertices),
                points=FollowedPoints(names, given.tracks.pixels[n, names].astype(np.float32)),
            )
        )
    object_map = replace(
        base,
        landmarks=solved.points,
        candidate=np.zeros(len(solved.points), bool),
        keyframes=tuple(keyframes),
    )
    return object_map, given.truth


def camera_of(fov: float) -> Camera:
    return replace(Camera.from_fov(*SIZE, fov), assumed=True)


def turns(object_map):
    return np.array([pose_arrays(view.pose)[0] for view in object_map.keyframes])


@pytest.fixture(scope="module")
def narrow():
    """Twenty degrees, taken for 45."""
    assumed, true = camera_of(45), camera_of(20)
    object_map, truth = solved_with(assumed, true, 20.0)
    return object_map, truth, solve_lens(object_map, assumed)


def test_the_focal_length_is_found(narrow):
    _, _, (_, camera) = narrow
    assert camera.fy == pytest.approx(camera_of(20).fy, rel=0.2)
    assert camera.fx == camera.fy
    assert (camera.cx, camera.cy) == (camera_of(20).cx, camera_of(20).cy)
    assert "solved field of view" in camera.origin


def test_the_object_turns_as_far_as_it_does_then(narrow):
    object_map, truth, (better, _) = narrow
    before, after = (degrees_between(turns(one), truth.R) for one in (object_map, better))
    assert before.max() > 5
    assert after.max() < 3


def test_the_windows_have_the_lens_too(narrow):
    object_map, _, (better, camera) = narrow
    factor = camera.fy / camera_of(45).fy
    for old, new in zip(object_map.keyframes, better.keyframes, strict=True):
        expected = new.observation.window.K(camera)
        torch.testing.assert_close(new.observation.K, torch.tensor(expected).float(), rtol=1e-5, atol=1e-3)
        assert new.pose.translation[2] == pytest.approx(factor * float(old.pose.translation[2]), rel=0.25)


def test_the_landmarks_are_seen_where_they_were(narrow):
    _, _, (better, camera) = narrow
    for view in better.keyframes:
        R, t = pose_arrays(view.pose)
        x_cam = better.landmarks[view.points.landmark] @ R.T + t
        place = (x_cam / x_cam[:, 2:]) @ camera.K.T
        assert np.median(np.linalg.norm(place[:, :2] - view.points.pixel, axis=1)) < 0.5


@pytest.mark.parametrize("fov", [20.0, 45.0])
def test_the_right_lens_stays_as_it_is(fov):
    camera = camera_of(fov)
    object_map, _ = solved_with(camera, camera, fov)
    assert solve_lens(object_map, camera) == (object_map, camera)


def test_a_small_turn_does_not_tell_the_lens():
    camera = camera_of(45)
    object_map, _ = solved_with(camera, camera_of(20), 20.0, turn=6, noise=0.5)
    assert solve_lens(object_map, camera) == (object_map, camera)


@pytest.mark.parametrize("degrees", [0.5, 6.7, 85.0])
def test_beyond_the_outermost_lens_that_was_tried_it_is_not_known(narrow, monkeypatch, degrees):
    object_map, _, _ = narrow
    assumed = camera_of(45)
    absurd = camera_of(degrees)
    monkeypatch.setattr(
        focal_length, "adjust", lambda tracks, K, start, **how: replace(
            start, cost=0.1 if "free_focal" in how else 1.0, focal_factor=absurd.fy / assumed.fy
        )
    )  # fmt: skip
    assert focal_length.solve_lens(object_map, assumed) == (object_map, assumed)


def test_few_landmarks_do_not_tell():
    object_map, _ = solved_with(camera_of(45), camera_of(20), 20.0, count=25)
    assert solve_lens(object_map, camera_of(45)) == (object_map, camera_of(45))
