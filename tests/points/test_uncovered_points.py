"""Points on parts without a surface while frames come: carried by the images, and by the surface once it is there."""

from __future__ import annotations

import numpy as np
import pytest
from solid_of_clip import mesh_of

from tracking3d.points.answers import PointAnswers
from tracking3d.points.image_following import ImageFollower
from tracking3d.points.image_only import UncoveredPoints
from tracking3d.points.online import KEPT, CausalPoints
from tracking3d.points.pictures import open_picture
from tracking3d.points.view import open_view
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize

FRAMES = 9
SMALL = 0.5


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=FRAMES))


@pytest.fixture(scope="module")
def surface(clip):
    return mesh_of(clip)


@pytest.fixture(scope="module")
def pictures(clip):
    return [open_picture(image, mask) for image, mask in zip(clip.images, clip.masks, strict=True)]


def small_views(clip, surface):
    vertices, faces = surface
    return [
        open_view(image, mask, clip.camera, T, vertices * SMALL, faces)
        for image, mask, T in zip(clip.images, clip.masks, clip.T_cam_obj, strict=True)
    ]


@pytest.fixture(scope="module")
def xy(clip):
    """One point that the small surface covers, four that it does not, and one beside the object."""
    x, y, width, height = clip.box
    inside = [
        (x + a * width, y + b * height)
        for a, b in ((0.5, 0.5), (0.2, 0.5), (0.8, 0.5), (0.5, 0.15), (0.5, 0.85))
    ]
    return np.array([*inside, (2.0, 2.0)])


def truth(clip, surface, xy):
    """``(T, N, 2)`` of points on the whole surface."""
    view = open_view(clip.images[0], clip.masks[0], clip.camera, clip.T_cam_obj[0], *surface)
    points = view.surface(view.to_window(xy))
    seen = np.einsum("tij,nj->tni", clip.T_cam_obj[:, :3, :3], points) + clip.T_cam_obj[:, None, :3, 3]
    pixels = seen @ clip.K.T
    return pixels[..., :2] / pixels[..., 2:]


def test_the_images_carry_them_until_the_surface_covers_them(clip, surface, pictures, xy):
    views, radius = small_views(clip, surface), SMALL * float(np.linalg.norm(np.ptp(surface[0], axis=0))) / 2
    group = CausalPoints(xy)
    by_surface = [group.step(0, views[0], radius)]
    assert group.on_surface().tolist() == [True, False, False, False, False, False]
    uncovered = UncoveredPoints(0, pictures[0], xy, group.on_surface())
    assert uncovered
    estimates = [uncovered.complete(0, by_surface[0], group.on_surface())]
    for index in range(1, FRAMES):
        by_surface.append(group.step(index, views[index], radius))
        uncovered.step(index, pictures[index])
        estimates.append(uncovered.complete(index, by_surface[-1], group.on_surface()))
    positions = np.stack([one.positions for one in estimates])
    assert np.isnan(np.stack([one.positions for one in by_surface])[:, 1:]).all()
    assert np.isnan(positions[:, 5]).all()  # beside the object
    error = np.linalg.norm(positions - truth(clip, surface, xy), axis=2)[:, 1:5]
    assert np.median(error) < 1.0
    told = np.stack([one.uncertainty for one in estimates])[:, 1:5]
    assert (error <= 2 * told).mean() > 0.9
    assert np.isnan(estimates[-1].points[1:]).all()
    np.testing.assert_array_equal(positions[0, 1:5], xy[1:5])

    group.redrawn(lambda index: None, *surface)
    again = group.again(2 * radius)
    assert group.on_surface().tolist() == [True] * 5 + [False]
    last = uncovered.complete(FRAMES - 1, again[FRAMES - 1], group.on_surface())
    np.testing.assert_array_equal(last.positions, again[FRAMES - 1].positions)
    assert np.isfinite(last.points[:5]).all()
    tied = np.linalg.norm(last.positions - truth(clip, surface, xy)[-1], axis=1)[:5]
    assert np.median(tied) < 0.5


def test_where_everything_is_covered_nothing_is_followed(pictures, xy):
    uncovered = UncoveredPoints(0, pictures[0], xy, np.array([True] * 5 + [False]))
    assert not uncovered
    uncovered.step(1, pictures[1])
    unknown = PointAnswers.unknown(6)
    assert uncovered.complete(1, unknown, np.zeros(6, bool)) is unknown


def test_what_is_kept_does_not_grow(pictures, xy):
    uncovered = UncoveredPoints(0, pictures[0], xy, np.zeros(6, bool))
    for index in range(1, 3 * KEPT):
        uncovered.step(index, pictures[index % FRAMES])
    assert len(uncovered._told) == KEPT
    assert uncovered._follower is not None and len(uncovered._follower._pictures) < KEPT


def test_backwards_begins_at_the_question_again(pictures, xy):
    there = ImageFollower(4, pictures[4], xy[:5])
    forwards = [there.step(index, pictures[index]) for index in (5, 6, 7)]
    backwards = [there.step(index, pictures[index]) for index in (3, 2)]
    fresh = ImageFollower(4, pictures[4], xy[:5])
    expected = [fresh.step(index, pictures[index]) for index in (3, 2)]
    for one, other in zip(backwards, expected, strict=True):
        np.testing.assert_array_equal(one.positions, other.positions)
    assert not np.allclose(forwards[0].positions, backwards[0].positions)
