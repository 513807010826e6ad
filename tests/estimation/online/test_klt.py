"""Points follow what moves, and are dropped where that cannot be known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from patterns import as_grey, disc, moved, shift, speckle, warped

from tracking3d.estimation.online.features.klt import FollowedPoints, follow, grey, new_corners

NONE = np.zeros((0, 2), np.float32)


def grid(left: int, top: int, right: int, bottom: int, step: int = 12) -> FollowedPoints:
    x, y = np.meshgrid(np.arange(left, right, step), np.arange(top, bottom, step))
    pixel = np.stack([x.ravel(), y.ravel()], 1).astype(np.float32)
    return FollowedPoints(100 + np.arange(len(pixel)), pixel)


def test_points_follow_a_shift_to_a_twentieth_of_a_pixel():
    image, motion = speckle(), shift(2.3, -1.6)
    start = grid(30, 30, 210, 170)
    found = follow(image, warped(image, motion), start)
    assert np.array_equal(found.landmark, start.landmark)
    error = np.abs(found.pixel - moved(start.pixel, motion))
    assert np.median(error) < 0.05 and error.max() < 0.2


def test_points_that_leave_the_image_are_dropped_and_the_others_keep_their_names():
    image, motion = speckle(), shift(-15, 0)
    start = grid(4, 40, 100, 160, 8)
    found = follow(image, warped(image, motion), start)
    assert (found.pixel >= 0).all()
    true = dict(zip(start.landmark.tolist(), moved(start.pixel, motion), strict=True))
    assert not {name for name, place in true.items() if place[0] < -1} & set(found.landmark.tolist())
    well_inside = {name for name, place in true.items() if place[0] > 12}
    assert well_inside <= set(found.landmark.tolist())
    for name, place in zip(found.landmark.tolist(), found.pixel, strict=True):
        if name in well_inside:
            assert np.linalg.norm(place - true[name]) < 0.3


def test_points_on_what_is_covered_are_dropped():
    image = speckle()
    later = image.copy()
    later[:, 120:] = speckle(seed=7)[:, 120:]
    seen, covered = grid(30, 30, 100, 170, 8), grid(140, 30, 220, 170, 8)
    assert len(follow(image, later, seen)) == len(seen)
    assert len(follow(image, later, covered)) < 0.15 * len(covered)


def test_points_that_slide_along_an_edge_and_do_not_come_back_are_dropped():
    """Along stripes only noise says where a point is, and it says something else there and back."""
    x, y = np.meshgrid(np.arange(240), np.arange(200))
    stripes = 128 + 60 * np.sin((x + y / 2) / 4)
    before, now = (as_grey(stripes + 3 * np.random.default_rng(seed).normal(size=x.shape)) for seed in (0, 1))
    start = grid(30, 30, 210, 170)
    assert len(follow(before, now, start)) < 0.45 * len(start)
    assert len(follow(before, before, start)) == len(start)


def test_on_an_image_without_texture_no_point_is_followed():
    plain = np.full((120, 120), 90, np.uint8)
    assert len(follow(plain, plain, grid(20, 20, 100, 100))) == 0


def test_a_guess_finds_motions_that_flow_alone_does_not():
    image, motion = speckle((300, 400)), shift(70, -30)
    later, start = warped(image, motion), grid(60, 80, 300, 260)
    guess = (moved(start.pixel, motion) + np.array([2, -2])).astype(np.float32)
    alone, guided = follow(image, later, start), follow(image, later, start, guess)
    right = np.abs(alone.pixel - moved(start.only(np.isin(start.landmark, alone.landmark)).pixel, motion))
    assert (right.max(1) < 1).sum() < 0.1 * len(start)
    assert len(guided) == len(start)
    assert np.abs(guided.pixel - moved(start.pixel, motion)).max() < 0.3


def test_a_guess_is_left_as_it_was():
    image, start = speckle(), grid(60, 60, 180, 140)
    guess = start.pixel + np.float32(1)
    before = guess.copy(), start.pixel.copy()
    follow(image, warped(image, shift(3, 2)), start, guess)
    assert np.array_equal(guess, before[0]) and np.array_equal(start.pixel, before[1])


def test_no_points_stay_no_points():
    image = speckle()
    assert len(follow(image, image, FollowedPoints.none())) == 0
    assert len(follow(image, image, FollowedPoints.none(), NONE)) == 0


def test_grey_is_the_brightness_of_rgb():
    colours = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], np.uint8)
    assert grey(colours).tolist() == [[76, 150, 29]]  # ITU-R BT.601


@pytest.mark.parametrize("radius", [25, 60])
def test_new_corners_lie_inside_the_mask_and_away_from_its_outline(radius):
    image, mask = speckle((200, 240), 1.2), disc((200, 240), (110, 95), radius)
    corners = new_corners(image, mask, NONE, 200)
    assert 20 < len(corners) <= 200
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    x, y = np.rint(corners).astype(int).T
    assert depth[y, x].min() > 0
    assert np.quantile(depth[y, x], 0.1) >= max(0.02 * np.sqrt(mask.sum()), 2)


def test_a_mask_at_the_border_of_the_image_has_corners_away_from_the_border():
    image = speckle(blur=1.2)
    corners = new_corners(image, np.ones(image.shape, bool), NONE, 500)
    assert corners.min() > 1 and (corners < np.array([238.0, 198.0])).all()


def test_new_corners_keep_away_from_points_that_are_there_and_from_each_other():
    image, mask = speckle(blur=1.2), np.ones((200, 240), bool)
    distance = np.sqrt(mask.sum()) / 25
    taken = new_corners(image, mask, NONE, 40)
    fresh = new_corners(image, mask, taken, 200)
    assert len(taken) == 40 and len(fresh) > 20
    gap = np.linalg.norm(fresh[:, None] - taken[None], axis=2).min(1)
    assert gap.min() > distance - 4 and np.quantile(gap, 0.1) > distance - 1
    between = np.linalg.norm(fresh[:, None] - fresh[None], axis=2) + 1e3 * np.eye(len(fresh))
    assert np.quantile(between.min(1), 0.1) > distance - 2


def test_corners_are_where_the_corners_are():
    image = np.full((100, 100), 40, np.uint8)
    image[30:61, 30:61] = 200  # its corners lie between pixels 29 and 30, and 60 and 61
    corners = new_corners(cv2.GaussianBlur(image, (0, 0), 1.0), np.ones((100, 100), bool), NONE, 10)
    expected = np.array([[29.5, 29.5], [29.5, 60.5], [60.5, 29.5], [60.5, 60.5]])
    gap = np.linalg.norm(expected[:, None] - corners[None], axis=2)
    assert len(corners) == 4 and gap.min(1).max() < 0.6


def test_corners_have_pixels_of_the_whole_image():
    image, mask = speckle((120, 120), 1.2), np.zeros((220, 260), bool)
    large = np.zeros((220, 260), np.uint8)
    large[70:190, 90:210] = image
    mask[70:190, 90:210] = True
    alone = new_corners(image, np.ones((120, 120), bool), NONE, 50)
    assert np.allclose(new_corners(large, mask, NONE, 50) - [90, 70], alone)


@pytest.mark.parametrize(
    "mask", [np.zeros((60, 60), bool), disc((60, 60), (30, 30), 1), disc((60, 60), (30, 30), 6)]
)
def test_masks_with_little_or_nothing_inside_have_no_corners(mask):
    assert new_corners(speckle((60, 60), 1.0), mask, NONE, 50).shape == (0, 2)


def test_none_are_found_where_none_are_wanted_or_there_is_no_texture():
    mask = np.ones((60, 60), bool)
    assert new_corners(speckle((60, 60)), mask, NONE, 0).shape == (0, 2)
    assert new_corners(speckle((60, 60)), mask, NONE, -5).shape == (0, 2)
    assert new_corners(np.full((60, 60), 7, np.uint8), mask, NONE, 9).shape == (0, 2)


def test_the_strongest_corners_come_first():
    few, many = (new_corners(speckle(blur=1.2), np.ones((200, 240), bool), NONE, most) for most in (10, 60))
    assert np.array_equal(few, many[:10])


def test_few_points_are_not_spread():
    points = grid(0, 0, 40, 40)
    assert points.spread_out(len(points), 200.0) is points


def test_spread_keeps_the_oldest_of_every_cell_first():
    """Cells of 10 pixels: three points in one, two in another, one in a third."""
    pixel = np.array([[1, 1], [2, 2], [25, 25], [3, 3], [26, 26], [95, 5]], np.float32)
    points = FollowedPoints(np.array([10, 11, 12, 13, 14, 15]), pixel)
    assert points.spread_out(3, 200.0).landmark.tolist() == [10, 12, 15]


def test_spread_fills_up_with_the_oldest_of_the_others_in_the_order_of_age():
    pixel = np.array([[1, 1], [2, 2], [25, 25], [3, 3], [26, 26], [95, 5]], np.float32)
    points = FollowedPoints(np.array([10, 11, 12, 13, 14, 15]), pixel)
    kept = points.spread_out(5, 200.0)
    assert kept.landmark.tolist() == [10, 11, 12, 13, 15]
    assert kept.pixel.tolist() == pixel[[0, 1, 2, 3, 5]].tolist()


def test_with_more_cells_than_room_the_oldest_stay_wherever_they_are():
    pixel = np.array([[95, 95], [50, 50], [5, 5]], np.float32)
    assert FollowedPoints(np.arange(3), pixel).spread_out(2, 200.0).landmark.tolist() == [0, 1]


def test_only_keeps_what_it_is_told():
    points = grid(0, 0, 30, 30)
    kept = points.only(points.pixel[:, 0] > 5)
    assert len(kept) == 6 and (kept.pixel[:, 0] > 5).all()
    assert kept.landmark.tolist() == points.landmark[points.pixel[:, 0] > 5].tolist()
