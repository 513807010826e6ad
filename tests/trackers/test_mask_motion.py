"""How the background moves in a crop: as simply as explains it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from moving_shape import clutter

from tracking3d.trackers.mask_motion import follow_mask

SIZE = 160
FLOOR = np.array([[1.04, 0.05, -6.0], [0.015, 1.08, -3.0], [1e-4, 9e-4, 1.0]])
"""From pixels of the present crop to those of the last one, as those of a floor that a camera goes round on."""
OBJECT = np.array([[1.0, 0.0, 4.0], [0.0, 1.0, 0.0]])
"""From pixels of the last crop to those of the present one."""


def grey(seed: int) -> np.ndarray:
    return clutter(seed, (SIZE, SIZE), (20, 20, 20), (230, 230, 230))[..., 0].round().astype(np.uint8)


def object_mask() -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), np.float32)
    cv2.circle(mask, (80, 80), 30, 1.0, -1)
    return mask


def crops(background: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The last crop, the present one, and the object's mask in the last one."""
    behind, before, mask = grey(1), grey(2), object_mask()
    last = np.where(mask > 0.5, before, behind)
    flags, border = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REFLECT
    moved = cv2.warpPerspective(behind, background, (SIZE, SIZE), flags=flags, borderMode=border)
    object_moved, moved_mask = (cv2.warpAffine(one, OBJECT, (SIZE, SIZE)) for one in (before, mask))
    return last, np.where(moved_mask > 0.5, object_moved, moved), mask


def off(found: np.ndarray, true: np.ndarray) -> float:
    """Pixels by which two homographies differ at most, in the crop."""
    corners = np.array([[[0, 0], [SIZE, 0], [0, SIZE], [SIZE, SIZE]]], float)
    ways = [cv2.perspectiveTransform(corners, matrix) for matrix in (found, true)]
    return float(np.linalg.norm(ways[0] - ways[1], axis=-1).max())


def test_a_floor_moves_by_its_homography() -> None:
    motion = follow_mask(*crops(FLOOR))
    assert motion.background is not None
    assert off(motion.background, FLOOR) < 1.5


def test_what_lies_on_the_floor_is_told_from_what_moves_with_the_object() -> None:
    motion = follow_mask(*crops(FLOOR))
    band = cv2.dilate((motion.moved).astype(np.uint8), np.ones((41, 41), np.uint8)) > 0
    beside = band & (cv2.dilate(motion.moved.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0)
    inside = cv2.erode(motion.moved.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert motion.cue[beside].mean() < -0.3
    assert motion.cue[inside].mean() > 0.3


@pytest.mark.parametrize(("right", "down"), [(0, 0), (5, -3)])
def test_a_background_that_stands_still_does_so_to_the_last_digit(right: int, down: int) -> None:
    still = np.array([[1.0, 0, right], [0, 1, down], [0, 0, 1]])
    motion = follow_mask(*crops(still), shift=(right, down))
    np.testing.assert_array_equal(motion.background, still)


@pytest.mark.parametrize("background", [np.eye(3), np.array([[1.02, 0.01, 3], [-0.01, 1.02, -2], [0, 0, 1]])])
def test_where_a_similarity_explains_as_much_it_is_one(background: np.ndarray) -> None:
    motion = follow_mask(*crops(background))
    assert motion.background is not None
    np.testing.assert_array_equal(motion.background[2], (0, 0, 1))
    (a, b), (c, d) = motion.background[:2, :2]
    np.testing.assert_allclose((a, b), (d, -c))
    assert off(motion.background, background) < 0.5


def test_what_else_moves_before_a_still_background_does_not_bend_it() -> None:
    last, present, mask = crops(np.eye(3))
    last[110:, :70] = grey(3)[110:, :70]
    present[110:, :70] = grey(3)[108:-2, 3:73]
    motion = follow_mask(last, present, mask)
    assert motion.background is not None
    assert off(motion.background, np.eye(3)) < 0.5


def test_what_lies_beyond_the_frame_says_nothing() -> None:
    last, present, mask = crops(np.eye(3))
    in_frame = np.ones((SIZE, SIZE), bool)
    in_frame[:, :48] = False
    last[:, :48], present[:, :48] = last[:, 48:49], grey(5)[:, :48]
    motion = follow_mask(last, present, mask, in_frame=in_frame)
    np.testing.assert_array_equal(motion.background, np.eye(3))


def test_where_nothing_is_seen_of_the_background_its_motion_is_not_known() -> None:
    last, present, _ = crops(np.eye(3))
    motion = follow_mask(last, present, np.ones((SIZE, SIZE), np.float32))
    assert motion.background is None
    np.testing.assert_array_equal(motion.cue, 0)
