"""What moves along with an object beside its mask: a box that turns before a still background, and its new side."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import trimesh
from twins import motion_cue

from tracking3d.estimation.segmentation.online_motion_cue import (
    MOVES,
    MotionReference,
    grow_region,
    motion_supported_share,
    online_motion_log_odds,
    unlike_surroundings,
)
from tracking3d.geometry.camera import Window
from tracking3d.scene.surface import draw_depth
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize

SIZE = 128


@pytest.fixture(scope="module")
def turning():
    """A box that turns by 5 degrees a frame, so that its right side comes into view."""
    spec = SyntheticSpec(
        "box", 8, (240, 180), 5.0, (0.0, 1.0, 0.0), drift=(0, 0, 0), clutter=1.0, supersample=1
    )
    return synthesize(spec)


def front() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the box's front, little more than a plate: all that is known of it so far."""
    plate = trimesh.creation.box((1.24, 0.96, 0.1))
    return np.asarray(plate.vertices) - [0, 0, 0.51], np.asarray(plate.faces, np.int64)


def glimpse(clip, number: int, known: np.ndarray) -> MotionReference:
    return MotionReference.of(
        cv2.cvtColor(clip.images[number], cv2.COLOR_RGB2GRAY), known, clip.T_cam_obj[number]
    )


def plates(clip) -> list[np.ndarray]:
    """``(H, W)`` silhouettes of the plate in every frame."""
    height, width = clip.masks.shape[1:]
    return [
        draw_depth(clip.camera.K, T_cam_obj, *front(), (height, width))[1] == 0
        for T_cam_obj in clip.T_cam_obj
    ]


def asked(clip, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, Window]:
    """What is said of a frame in its window, where the object is known to be and where it is; and the window."""
    known = plates(clip)
    seen = [glimpse(clip, index, known[index]) for index in range(number + 1)]
    x, y, width, height = cv2.boundingRect(known[number].astype(np.uint8))
    window = Window.around((float(x), float(y), float(width), float(height)), 0.4, SIZE)
    told = online_motion_log_odds(seen[-1], seen[:-1], window, clip.camera, *front())
    assert told is not None
    rows, columns = np.mgrid[:SIZE, :SIZE]
    u, v, _ = np.einsum("ij,jrc->irc", window.to_frame, np.stack([columns, rows, np.ones_like(rows)]))
    inside = (u > 0) & (v > 0) & (u < known[0].shape[1] - 1) & (v < known[0].shape[0] - 1)
    at = (
        np.rint(v).astype(int).clip(0, known[0].shape[0] - 1),
        np.rint(u).astype(int).clip(0, known[0].shape[1] - 1),
    )
    return told, known[number][at], clip.masks[number][at] & inside, window


@pytest.mark.parametrize("number", [4, 6])
def test_a_side_that_turns_into_view_moves_along_and_the_background_does_not(turning, number):
    told, known, truth, _ = asked(turning, number)
    wide = cv2.dilate(truth.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    narrow = cv2.erode((truth & ~known).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    side, beside = told[narrow], told[~wide]
    assert (side > MOVES).mean() > 0.1 > 0.02 > (side < -MOVES).mean()
    assert (beside < -MOVES).mean() > 0.1 > 0.03 > (beside > MOVES).mean()


def test_it_says_the_same_without_the_kernel(turning, monkeypatch):
    fast = asked(turning, 4)[0]
    monkeypatch.setattr(
        "tracking3d.estimation.segmentation.online_motion_cue.motion_parallax", motion_cue.parted_ways
    )
    assert np.mean(np.abs(fast - asked(turning, 4)[0]) > 0.02) < 0.01  # where rounding decides


def test_what_does_not_move_tells_nothing(turning):
    known = plates(turning)[0]
    here = glimpse(turning, 0, known)
    window = Window(40, 10, 160, SIZE)
    assert online_motion_log_odds(here, [], window, turning.camera, *front()) is None
    assert online_motion_log_odds(here, [here] * 5, window, turning.camera, *front()) is None


def test_an_object_that_fills_the_frame_leaves_no_background_to_compare_with(turning):
    everything = np.ones(turning.masks.shape[1:], bool)
    seen = [glimpse(turning, number, everything) for number in range(5)]
    assert (
        online_motion_log_odds(seen[-1], seen[:-1], Window(40, 10, 160, SIZE), turning.camera, *front())
        is None
    )


def test_pixels_of_a_glimpse_are_those_of_the_frame():
    grey = np.zeros((600, 960), np.uint8)
    grey[300:302, 480:482] = 255
    seen = MotionReference.of(grey, grey > 0, np.eye(4))
    assert seen.grey.shape == (300, 480) and seen.grey.max() == seen.grey[150, 240]
    np.testing.assert_allclose(seen.to_small @ [480.5, 300.5, 1], [240, 150, 1])


def test_the_new_side_is_taken_in(turning):
    told, known, truth, _ = asked(turning, 6)
    odds = np.where(known, 3.0, -3.0).astype(np.float32)
    strange = np.zeros_like(odds)
    after = grow_region(odds, known, known, told, strange) > 0

    def iou(mask):
        return (mask & truth).sum() / (mask | truth).sum()

    assert iou(after) > iou(known) + 0.01
    assert (after & truth & ~known).sum() > 4 * (after & ~truth).sum()


def square(x0: int, x1: int, y0: int = 40, y1: int = 80) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[y0:y1, x0:x1] = True
    return mask


KNOWN = square(30, 70)
ODDS = np.where(KNOWN, 4.0, -4.0).astype(np.float32)


def added(moving: np.ndarray, strange: np.ndarray | float = 0.0) -> np.ndarray:
    strange = np.broadcast_to(np.float32(strange), moving.shape)
    return (grow_region(ODDS, KNOWN, KNOWN, moving.astype(np.float32), strange) > 0) & ~KNOWN


def test_what_moves_along_beside_the_object_is_taken_in_with_the_gaps_between():
    moving = np.where(square(75, 80), 0.9, 0.0)  # five pixels beside it
    assert added(moving)[45:75, 70:75].mean() > 0.9
    assert not added(moving)[:, 80:].any() and not added(moving)[:, :70].any()


def test_what_moves_along_elsewhere_is_not():
    assert not added(np.where(square(100, 110), 0.9, 0.0)).any()


def test_an_edge_that_moves_does_not_take_a_strip_beside_it_along():
    assert not added(np.where(square(70, 72), 0.9, 0.0)).any()


def test_what_goes_on_beyond_the_object_is_an_arm():
    assert not added(np.where(square(70, 80), 0.9, 0.0), -2.0).any()


def test_motion_tells_which_of_two_masks_is_right():
    odds = np.zeros((SIZE, SIZE), np.float32)
    wide = square(30, 80)
    moving = np.where(square(70, 80), -1.0, 0.0).astype(np.float32)
    assert (grow_region(odds, wide, KNOWN, moving, odds)[40:80, 70:80] < 0).all()
    assert (grow_region(odds, wide, KNOWN, -moving, odds)[40:80, 70:80] > 0).all()


def test_colours_of_the_surroundings_are_told_from_new_ones():
    image = np.full((SIZE, SIZE, 3), (120, 120, 120), np.uint8)
    image[KNOWN] = (200, 128, 128)
    image[square(70, 80)] = (80, 180, 90)
    found = unlike_surroundings(image, KNOWN)
    assert found[square(70, 80)].min() > -1 > found[100:].max()


def test_parts_are_vouched_for_as_a_whole():
    moving = np.where(square(70, 74), 0.9, 0.0)
    grown = square(30, 80)
    assert motion_supported_share(grown, KNOWN, moving) == pytest.approx(0.2)
    assert motion_supported_share(grown, KNOWN, np.zeros_like(moving)) == 0
    assert motion_supported_share(KNOWN, grown, -moving) == pytest.approx(0.25)
    assert motion_supported_share(np.zeros_like(KNOWN), KNOWN, moving) == 0
