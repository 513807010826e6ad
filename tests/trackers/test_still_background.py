"""A background that is known and stands still decides, whatever the network of `segment` says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from moving_shape import SIZE, box_around, iou, moving_shape

from tracking3d.scene.view import crop_window
from tracking3d.trackers.background import BackgroundMemory
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.segmentation import ColourSegmentation

CUES = Cues(
    prior=0.5, outline=0.0, novelty=0.0, network=3.0, global_colours=0.0, local_colours=0.0, motion=0.0, background=0.5
)  # fmt: skip

STRIPES = np.arange(SIZE[1]) // 6 % 2 == np.zeros((SIZE[0], 1))


class Claims:
    """A network that says what it is told, ``(H, W)`` in [-1, 1] of the frame: the object, and what is before it."""

    def __init__(self) -> None:
        self.maps = np.zeros((2, 1, 1))

    def log_odds(self, image, present, motion, colours, last):
        return tuple(4 * crop_window(one.astype(np.float32), present.window) for one in self.maps)


@pytest.fixture
def at_rest(monkeypatch) -> None:
    """The camera is known to stand still: in tiny frames its motion is hard to tell from the object's."""
    monkeypatch.setattr(BackgroundMemory, "move", lambda self, *camera_motion: None)


def last_mask(frames, truth, claims) -> np.ndarray | None:
    """The mask in the last frame, if in each the network claims ``claims(true mask)``: the object and an occluder."""
    network = Claims()
    segmentation = ColourSegmentation(
        frames[0].image, box_around(truth[0]), truth[0], cues=CUES, network=network
    )
    for frame, mask in zip(frames[1:], truth[1:], strict=True):
        network.maps = claims(mask)
        estimate = segmentation.step(frame.image)
    return estimate.binary


def beside(mask: np.ndarray) -> np.ndarray:
    """The background right beside the object, on the side to which it moves."""
    return np.roll(mask, 10, axis=1) & ~mask


def too_much(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.where(mask | beside(mask), 1, -1), np.full(mask.shape, -1)


def test_background_that_the_network_takes_for_the_object_stays_out_of_the_mask():
    frames, truth = moving_shape(8)
    assert iou(last_mask(frames, truth, too_much), truth[-1]) > 0.95


def test_before_a_camera_that_moves_the_network_decides():
    frames, truth = moving_shape(8)
    frames = [replace(one, image=np.roll(one.image, 2 * n, axis=0)) for n, one in enumerate(frames)]
    truth = [np.roll(one, 2 * n, axis=0) for n, one in enumerate(truth)]
    assert iou(last_mask(frames, truth, too_much), truth[-1]) < 0.92


def test_before_a_plain_background_the_object_keeps_a_side_that_has_the_colour_of_it(at_rest):
    frames, truth = moving_shape(14, step=9)
    for frame, mask in zip(frames, truth, strict=True):
        side = np.roll(mask, -30, axis=1) & mask
        frame.image[~mask | side] = (60, 90, 120)
    mask = last_mask(frames, truth, lambda mask: (np.where(mask, 1, -1), np.full(mask.shape, -1)))
    assert iou(mask, truth[-1]) > 0.8


@pytest.mark.parametrize("in_front", [False, True])
def test_what_has_come_before_the_background_is_the_object_unless_it_is_an_occluder(in_front: bool):
    frames, truth = moving_shape(8)
    for frame, mask in zip(frames[4:], truth[4:], strict=True):
        frame.image[beside(mask)] = (0, 255, 0)

    def doubtful(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        doubt = beside(mask)
        return np.where(mask, 1, np.where(doubt, -0.25, -1)), np.where(doubt & in_front, 1, -1)

    taken = last_mask(frames, truth, doubtful) & beside(truth[-1])
    share = taken.sum() / beside(truth[-1]).sum()
    assert share < 0.1 if in_front else share > 0.6


@pytest.mark.parametrize("moves", [False, True])
def test_a_large_side_that_comes_at_once_is_believed_before_a_camera_that_stands_still(moves: bool):
    frames, truth = moving_shape(8)
    if moves:
        frames = [replace(one, image=np.roll(one.image, 2 * n, axis=0)) for n, one in enumerate(frames)]
        truth = [np.roll(one, 2 * n, axis=0) for n, one in enumerate(truth)]
    side = np.roll(truth[-1], truth[-1].any(0).sum() // 2, axis=1) & ~truth[-1]
    frames[-1].image[side] = (0, 255, 0)
    mask = last_mask(frames, truth, lambda mask: (np.where(mask, 1, -0.5), np.full(mask.shape, -1)))
    taken = (mask & side).sum() / side.sum()
    assert taken < 0.1 if moves else taken > 0.8


def test_a_mask_that_shows_nothing_but_background_is_given_up(monkeypatch):
    frames, truth = moving_shape(2)
    nothing_new = lambda self, image, window: np.full((window.size, window.size), -0.5, np.float32)  # noqa: E731
    monkeypatch.setattr(BackgroundMemory, "change", nothing_new)
    for frame in frames:
        frame.image[STRIPES] //= 3
    assert last_mask(frames, truth, lambda mask: (np.where(mask, 1, -1), np.full(mask.shape, -1))) is None
