"""Views are cut out around the object, and the few that are kept see it from all sides, the sharpest of each."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from rendered_views import CAMERA, pattern, pose, seen, view

from tracking3d.reconstruction import keep_best_views, texture_view
from tracking3d.scene.view import ObjectView


def test_a_view_is_the_frame_around_the_object_at_its_own_resolution():
    T_cam_obj = pose(20)
    image, mask = seen(T_cam_obj, np.full((8, 8, 3), 0.5, np.float32))
    found = texture_view(ObjectView.of_frame(7, image, mask, CAMERA, T_cam_obj))
    assert found is not None and found.index == 7
    rows, columns = np.nonzero(mask)
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    assert extent <= len(found.image) <= 1.2 * extent
    # A point of the object is where the window's intrinsics say, and shows the object's colour.
    x, y, z = T_cam_obj[:3, 3]
    column, row = (found.K @ (x / z, y / z, 1))[:2].round().astype(int)
    assert found.interior[row, column] == 1
    assert found.image[row, column] == pytest.approx(np.full(3, 128), abs=1)


def test_the_outline_belongs_to_nobody():
    found = view(0, 0.0)
    green = (found.image[..., 1] > 250) & (found.image[..., 0] < 5)
    assert green.any()
    assert not found.interior[cv2.dilate(green.astype(np.uint8), np.ones((3, 3))) > 0].any()


@pytest.mark.parametrize("mask", ["empty", "a speck"])
def test_without_an_inside_there_is_no_view(mask):
    image, object_ = seen(pose(0), np.full((8, 8, 3), 0.5, np.float32))
    object_[:] = False
    object_[40:41, 40:41] = mask == "a speck"
    assert texture_view(ObjectView.of_frame(0, image, object_, CAMERA, pose(0))) is None


def test_a_large_object_is_seen_smaller():
    image, mask = np.zeros((2000, 2000, 3), np.uint8), np.zeros((2000, 2000), bool)
    mask[100:1900, 100:1900] = True
    found = texture_view(ObjectView.of_frame(0, image, mask, CAMERA, pose(0)))
    assert found is not None
    assert len(found.image) == len(found.interior) == 640


def test_those_that_are_kept_are_spread_over_all_that_was_seen():
    one, views = view(0, 0.0), ()
    for index, yaw in enumerate(np.linspace(0, 180, 61)):
        views = keep_best_views(views, replace(one, index=index, T_cam_obj=pose(yaw)), 7)
    angles = [np.degrees(np.arccos(np.clip(a.direction @ b.direction, -1, 1))) for a, b in pairwise(views)]
    assert len(views) == 7
    assert sum(angles) > 150 and min(angles) > 10


def test_of_two_that_see_the_same_the_sharper_one_stays():
    image, mask = seen(pose(0), pattern())
    blurred = texture_view(ObjectView.of_frame(1, cv2.GaussianBlur(image, (0, 0), 3), mask, CAMERA, pose(0)))
    sharp, other = view(0, 0.0), view(2, 90.0)
    assert blurred is not None and blurred.sharpness < 0.5 * sharp.sharpness
    for order in ((blurred, sharp, other), (other, sharp, blurred)):
        views = ()
        for one in order:
            views = keep_best_views(views, one, 2)
        assert {one.index for one in views} == {0, 2}


def test_of_two_that_see_the_same_the_one_that_something_hides_goes_however_sharp_it_is():
    image, mask = seen(pose(0), pattern())
    left = mask & (np.arange(mask.shape[1]) < np.flatnonzero(mask.any(0)).mean())
    hidden = texture_view(ObjectView.of_frame(1, image, left, CAMERA, pose(0)))
    soft = texture_view(ObjectView.of_frame(3, cv2.GaussianBlur(image, (0, 0), 3), mask, CAMERA, pose(0)))
    assert hidden is not None and soft is not None and hidden.sharpness > 2 * soft.sharpness
    for order in ((hidden, soft), (soft, hidden)):
        assert [one.index for one in keep_best_views(order[:1], order[1], 1)] == [3]


def test_none_are_kept_where_none_are_asked_for():
    assert keep_best_views((), view(0, 0.0), 0) == ()
