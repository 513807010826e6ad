"""The background memory: what has changed, what has not, and what it cannot know."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import twins.background
from moving_shape import clutter

from tracking3d.geometry.camera import Window
from tracking3d.trackers import background
from tracking3d.trackers.background import BackgroundMemory

SHAPE = (90, 120)
WINDOW = Window(20, 5, 80, 80)


def picture(seed: int = 0) -> np.ndarray:
    return clutter(seed, SHAPE, (20, 40, 60), (200, 160, 220)).round().astype(np.uint8)


def everywhere(value: float = 1.0) -> np.ndarray:
    return np.full((80, 80), value, np.float32)


def nothing_known() -> BackgroundMemory:
    return BackgroundMemory(picture(), np.zeros(SHAPE, bool))


def memory(
    image: np.ndarray, background: np.ndarray | None = None, frames: int = 4, proof: float = 1.0
) -> BackgroundMemory:
    background = np.ones((80, 80), bool) if background is None else background
    kept = nothing_known()
    for _ in range(frames):
        kept.learn(image, WINDOW, background, everywhere(proof))
    return kept


def test_the_same_picture_has_not_changed() -> None:
    image = picture()
    image.flags.writeable = False  # as frames are
    np.testing.assert_allclose(memory(image).change(image, WINDOW), -0.5)
    np.testing.assert_allclose(memory(image).unchanged_score(image)[5:80, 20:95], 1)


def test_a_patch_of_another_colour_has_changed_and_nothing_else() -> None:
    image = picture()
    image[40:60, 50:70] = 255 - image[40:60, 50:70] // 2
    change = memory(picture()).change(image, WINDOW)
    assert (change[38:52, 33:47] > 0.9).mean() > 0.9
    change[33:57, 28:52] = -0.5
    np.testing.assert_allclose(change, -0.5)


def test_noise_that_was_seen_is_no_change() -> None:
    rng = np.random.default_rng(0)

    def noisy() -> np.ndarray:
        return np.clip(picture() + rng.normal(0, 12, (*SHAPE, 3)), 0, 255).astype(np.uint8)

    kept = nothing_known()
    for _ in range(15):
        kept.learn(noisy(), WINDOW, np.ones((80, 80), bool), everywhere())
    assert (kept.change(noisy(), WINDOW) < 0).mean() > 0.99


def test_where_the_object_has_always_been_nothing_is_known() -> None:
    background = np.ones((80, 80), bool)
    background[20:40, 30:50] = False
    change = memory(picture(), background).change(255 - picture(), WINDOW)
    np.testing.assert_array_equal(change[20:40, 30:50], 0)
    assert np.delete(change, np.s_[20:40], axis=0).min() > -0.5 and change[50:].mean() > 0.5


def test_what_is_known_for_one_frame_counts_less_than_what_is_known_for_many() -> None:
    once, often = (memory(picture(), frames=n).change(picture(), WINDOW) for n in (1, 6))
    np.testing.assert_allclose(once, often / 3)


def test_what_lay_beside_the_object_in_the_first_frame_is_known_everywhere() -> None:
    beside = np.ones(SHAPE, bool)
    beside[30:60, 40:80] = False
    kept = BackgroundMemory(picture(), beside)
    image = picture()
    image[:20, :20] = 255 - image[:20, :20] // 2
    unchanged = kept.unchanged_score(image)
    np.testing.assert_array_equal(unchanged[30:60, 40:80], 0)
    assert unchanged[:18, :18].max() < 0.1
    beside[:22, :22] = False
    np.testing.assert_allclose(unchanged[beside], 1)


def test_what_nothing_proves_is_not_held_for_background() -> None:
    np.testing.assert_array_equal(memory(picture(), proof=0.0).change(picture(), WINDOW), 0)


def test_proof_adds_up_frame_by_frame_and_can_be_taken_back() -> None:
    kept = memory(picture(), frames=4, proof=0.125)
    np.testing.assert_allclose(kept.change(picture(), WINDOW), -0.25)
    for _ in range(2):
        kept.learn(picture(), WINDOW, np.ones((80, 80), bool), everywhere(-0.125))
    np.testing.assert_allclose(kept.change(picture(), WINDOW), -0.125)


def with_visitor(left: int) -> np.ndarray:
    """The picture with something before it, 20 pixels wide."""
    image = picture()
    image[40:60, left : left + 20] = clutter(7, (20, 20), (230, 20, 20), (255, 90, 60))
    return image


def test_what_passes_outside_the_mask_does_not_become_background() -> None:
    kept = memory(picture(), frames=10)
    for step in range(6):
        kept.learn(with_visitor(40 + 2 * step), WINDOW, np.ones((80, 80), bool), everywhere())
    change = kept.change(with_visitor(52), WINDOW)
    assert change[37:53, 34:50].min() > 0.9  # the visitor, but for its edge
    assert change[37:53, 20:30].max() < -0.4  # where it was


def test_what_comes_to_stay_becomes_background() -> None:
    kept = memory(picture(), frames=10)
    for _ in range(30):
        kept.learn(with_visitor(50), WINDOW, np.ones((80, 80), bool), everywhere())
    assert kept.change(with_visitor(50), WINDOW).max() < -0.4


def camera_motion(right: int, down: int) -> tuple[np.ndarray, Window, Window, tuple[np.ndarray, np.ndarray]]:
    """What ``move`` is told of a camera that moves by so many pixels."""
    shift = np.array([[1, 0, -right], [0, 1, -down]], float)
    present = cv2.warpAffine(picture(), shift, SHAPE[::-1], borderMode=cv2.BORDER_REPLICATE)
    present_to_last = np.array([[1, 0, right], [0, 1, down], [0, 0, 1]], float)
    return present_to_last, WINDOW, WINDOW, (picture(), present)


def test_what_moves_before_a_camera_that_stands_still_is_no_motion_of_the_camera() -> None:
    kept = memory(picture())
    told, *windows, _ = camera_motion(3, 0)
    kept.move(told, *windows, (picture(), with_visitor(50)))
    assert kept.stands_still
    kept.move(*camera_motion(3, 0))
    assert not kept.stands_still


def test_a_camera_that_is_not_followed_is_forgotten_unless_it_stood_still() -> None:
    kept = memory(picture())
    kept.lose()
    np.testing.assert_allclose(kept.change(picture(), WINDOW), -0.5)
    kept.move(*camera_motion(2, 0))
    kept.lose()
    np.testing.assert_array_equal(kept.change(picture(), WINDOW), 0)


@pytest.mark.parametrize(("right", "down"), [(3, 0), (-2, 5)])
def test_the_memory_moves_with_the_camera(right: int, down: int) -> None:
    kept = memory(picture())
    shift = np.array([[1, 0, right], [0, 1, down]], float)
    moved = cv2.warpAffine(picture(), shift, SHAPE[::-1], borderMode=cv2.BORDER_REPLICATE)
    unmoved = kept.change(moved, WINDOW)
    kept.move(*camera_motion(-right, -down))
    inner = np.s_[12:-12, 12:-12]
    assert kept.change(moved, WINDOW)[inner].max() < -0.4
    assert (unmoved > 0).mean() > 0.1


def test_of_a_camera_that_moves_only_what_has_not_changed_counts() -> None:
    kept = memory(picture())
    kept.move(*camera_motion(3, 0))
    assert kept.change(255 - picture(), WINDOW).max() == 0
    moved = cv2.warpAffine(picture(), np.array([[1, 0, -3], [0, 1, 0]], float), SHAPE[::-1])
    assert kept.change(moved, WINDOW)[10:-10, 10:-10].max() < -0.4


def test_a_motion_of_crops_alone_is_none_of_the_camera() -> None:
    kept = memory(picture())
    elsewhere = Window(26, 9, 80, 80)
    kept.move(np.array([[1, 0, 6], [0, 1, 4], [0, 0, 1]], float), WINDOW, elsewhere, (picture(), picture()))
    np.testing.assert_allclose(kept.change(picture(), WINDOW), -0.5)


def test_what_is_forgotten_is_not_known() -> None:
    kept = memory(picture())
    mask = np.zeros(SHAPE, bool)
    mask[30:50, 40:60] = True
    kept.forget(mask)
    change = kept.change(255 - picture(), WINDOW)
    np.testing.assert_array_equal(change[25:45, 20:40], 0)


@pytest.mark.parametrize(
    "window", [Window(-40, -40, 80, 64), Window(100, 70, 60, 64), Window(300, 300, 20, 64)]
)
def test_windows_beyond_the_frame_are_answered(window: Window) -> None:
    kept = nothing_known()
    kept.learn(picture(), window, np.ones((64, 64), bool), np.ones((64, 64), np.float32))
    change = kept.change(picture(), window)
    assert change.shape == (64, 64) and change.max() <= 0


def memory_of(rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """What is remembered of a part of a frame: mean, variance, frames, and what is proven."""
    mean = rng.uniform(0, 255, (90, 120, 3)).astype(np.float32)
    spread, frames, proven = rng.uniform((4, 0, 0), (200, 20, 1), (90, 120, 3)).astype(np.float32).T
    frames[rng.random(frames.shape) < 0.2] = 0
    return tuple(plane[10:80, 5:100] for plane in (mean, spread.T, frames.T, proven.T))


def test_the_kernels_agree_with_their_twins() -> None:
    rng = np.random.default_rng(3)
    kept, seen, proof = memory_of(rng), rng.random((70, 95)) < 0.7, rng.normal(0, 1, (70, 95))
    present = np.clip(kept[0] + rng.normal(0, 15, kept[0].shape), 0, 255).astype(np.uint8)
    answers = []
    for module in (background, twins.background):
        memory = tuple(plane.copy() for plane in kept)
        difference = module.differences(present, *memory[:2])
        module.learn(present, difference < 0.2, seen, proof.astype(np.float32), memory)
        answers.append((difference, *memory))
    assert 0.1 < (answers[0][0] < 0.2).mean() < 0.9
    for ours, theirs in zip(*answers, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_values_between_those_of_the_neighbours_do_not_differ() -> None:
    rng = np.random.default_rng(5)
    present, mean = (rng.integers(0, 256, (12, 15, 3)).astype(np.uint8) for _ in range(2))
    variance = rng.uniform(4, 90, (12, 15)).astype(np.float32)
    found = background.differences(present, mean.astype(np.float32), variance)
    for row in range(12):
        for column in range(15):
            around = (
                mean[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].reshape(-1, 3).astype(float)
            )
            value = present[row, column].astype(float)
            beyond = np.maximum(np.maximum(value - around.max(0), around.min(0) - value), 0)
            expected = (beyond**2).mean() / (variance[row, column] + 3.6**2)
            assert found[row, column] == pytest.approx(expected, rel=1e-5)


def test_what_is_learnt_is_compared_with_the_memory_itself() -> None:
    kept = memory(picture(), frames=10)
    kept.change(picture(), WINDOW)
    kept.learn(with_visitor(50), WINDOW, np.ones((80, 80), bool), everywhere())
    assert kept.change(picture(), WINDOW).max() < -0.4
    assert kept.change(with_visitor(50), WINDOW)[37:53, 32:48].min() > 0.9
