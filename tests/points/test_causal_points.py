"""Points followed while frames come: right where surface and poses are, and never by what comes later."""

from __future__ import annotations

import numpy as np
import pytest
from solid_of_clip import mesh_of

from tracking3d.points.answers import PointAnswers
from tracking3d.points.online import KEPT, CausalPoints
from tracking3d.points.view import open_view
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize

FRAMES = 9


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES))


@pytest.fixture(scope="module")
def surface(clip):
    return mesh_of(clip)


@pytest.fixture(scope="module")
def radius(surface) -> float:
    return float(np.linalg.norm(np.ptp(surface[0], axis=0))) / 2


@pytest.fixture(scope="module")
def xy(clip):
    x, y, width, height = clip.box
    return np.array([(x + a * width, y + b * height) for a in (0.35, 0.5, 0.65) for b in (0.35, 0.5, 0.65)])


def views(clip, surface, poses=None):
    poses = clip.T_cam_obj if poses is None else poses
    return [
        open_view(image, mask, clip.camera, T, *surface)
        for image, mask, T in zip(clip.images, clip.masks, poses, strict=True)
    ]


def truth(clip, surface, xy):
    """``(T, N, 2)``."""
    points = views(clip, surface)[0]
    inside = points.surface(points.to_window(xy))
    seen = np.einsum("tij,nj->tni", clip.T_cam_obj[:, :3, :3], inside) + clip.T_cam_obj[:, None, :3, 3]
    pixels = seen @ clip.K.T
    return pixels[..., :2] / pixels[..., 2:]


def errors(estimates, clip, surface, xy):
    return np.linalg.norm(np.stack([one.positions for one in estimates]) - truth(clip, surface, xy), axis=2)


@pytest.fixture(scope="module")
def followed(clip, surface, radius, xy) -> list[PointAnswers]:
    points = CausalPoints(xy)
    return [points.step(index, view, radius) for index, view in enumerate(views(clip, surface))]


def test_with_the_true_surface_and_poses_points_are_where_they_are(followed, clip, surface, xy):
    assert np.median(errors(followed, clip, surface, xy)) < 0.2
    assert np.stack([one.measured for one in followed[1:]]).mean() > 0.8
    np.testing.assert_array_equal(followed[0].positions, xy)


def test_images_correct_poses_that_are_off(clip, surface, radius, xy):
    shifted = clip.T_cam_obj.copy()
    shifted[:, 0, 3] += 0.01 * np.arange(FRAMES)  # half a pixel more in every frame
    points = CausalPoints(xy)
    estimates = [points.step(index, view, radius) for index, view in enumerate(views(clip, surface, shifted))]
    seen = shifted[:, None, :3, 3] - clip.T_cam_obj[:, None, :3, 3]
    by_pose = np.abs(seen[1:, 0, 0] * clip.K[0, 0] / clip.T_cam_obj[1:, 2, 3]).mean()
    assert np.median(errors(estimates, clip, surface, xy)[1:]) < 0.5 * by_pose


def test_what_comes_later_changes_nothing_that_was_said(followed, clip, surface, radius, xy):
    points = CausalPoints(xy)
    for index, view in enumerate(views(clip, surface)[:4]):
        estimate = points.step(index, view, radius)
        np.testing.assert_array_equal(estimate.positions, followed[index].positions)


def test_where_the_object_is_lost_nothing_is_said_and_points_come_back(followed, clip, surface, radius, xy):
    gone = views(clip, surface)
    gone[3] = gone[4] = None
    points = CausalPoints(xy)
    estimates = [points.step(index, view, radius) for index, view in enumerate(gone)]
    for index in (3, 4):
        assert np.isnan(estimates[index].positions).all()
        assert not estimates[index].visible.any()
    assert np.median(errors(estimates, clip, surface, xy)[5:]) < 0.3


def test_a_pixel_beside_the_object_has_no_answer(clip, surface, radius):
    points = CausalPoints(np.array([(0.0, 0.0)]))
    for index, view in enumerate(views(clip, surface)[:2]):
        estimate = points.step(index, view, radius)
        assert (
            np.isnan(estimate.positions).all()
            and np.isnan(estimate.points).all()
            and not estimate.visible.any()
        )


def test_better_poses_of_the_past_make_its_answers_anew(followed, clip, surface, radius, xy):
    at_first = np.repeat(clip.T_cam_obj[:1], FRAMES, 0)  # as long as nothing is solved
    points = CausalPoints(xy)
    for index, view in enumerate(views(clip, surface, at_first)):
        points.step(index, view, radius)
    points.redrawn(lambda index: (clip.camera, clip.T_cam_obj[index]), *surface)
    again = points.again(radius)
    assert list(again) == list(range(FRAMES))
    assert np.median(errors(list(again.values()), clip, surface, xy)) < 0.3


def test_views_do_not_add_up_and_backwards_begins_at_the_question(clip, surface, radius, xy):
    some = views(clip, surface)
    points = CausalPoints(xy)
    for turn in range(3 * KEPT):
        points.step(turn, some[0], radius)
    assert len(points._rows) == KEPT
    points = CausalPoints(xy)
    for index in (4, 5, 6, 7, 3, 2):
        estimate = points.step(index, some[index], radius)
        if index == 4:
            start = estimate.points
    np.testing.assert_allclose(estimate.points, start, atol=0.05 * radius)
