"""The answered mask: what the image shows between the silhouette and the initial mask, in the pixels of the frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from patterns import disc

from tracking3d.estimation.estimate import MaskSource
from tracking3d.estimation.observation import observe
from tracking3d.estimation.online.masks import fuse_mask, mask_in_window, update_colours, upsampled_window
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, Window

SIZE = (160, 240)
TRUTH = disc(SIZE, (106, 80), 50)
CAMERA = Camera.from_fov(SIZE[1], SIZE[0])


def observed(truth, initial, window=None):
    """A warm object before a cool background."""
    random = np.random.default_rng(0)
    colours = np.where(truth[..., None], (200, 120, 60), (60, 110, 170)) + random.normal(0, 5, (*SIZE, 3))
    frame = Frame(0, np.clip(colours, 0, 255).astype(np.uint8))
    window = window or Window.around((56.0, 30.0, 100.0, 100.0), 0.3, 128)
    return observe(frame, initial, window, CAMERA, RgbEncoder(), torch.device("cpu"))


def iou(a, b):
    return float((a & b).sum() / (a | b).sum())


def answer(truth, rendered, initial, window=None, confidence=0.8):
    found = fuse_mask(rendered, initial, observed(truth, initial, window), confidence, None)
    return found.mask, found.source


def test_without_an_initial_mask_it_is_the_silhouette():
    mask, source = answer(TRUTH, TRUTH, None)
    np.testing.assert_array_equal(mask, TRUTH)
    assert source is MaskSource.RENDERED


def test_the_mask_is_where_the_probability_is_above_a_half():
    aside = disc(SIZE, (114, 80), 50)
    found = fuse_mask(TRUTH, aside, observed(TRUTH, aside, None), 0.8, None)
    mask, probability = found.mask, found.probability
    np.testing.assert_array_equal(mask, probability > 0.5)
    assert 0 <= probability.min() < 0.1 and 0.9 < probability.max() <= 1
    undecided = (probability > 0.3) & (probability < 0.7)
    assert 0 < undecided.mean() < 0.1


def test_two_masks_that_are_right_are_kept():
    mask, source = answer(TRUTH, TRUTH, TRUTH)
    assert iou(mask, TRUTH) > 0.97
    assert source is MaskSource.FUSED


@pytest.mark.parametrize("shift", [-8, 8])
def test_of_two_masks_the_image_tells_which_is_right(shift):
    aside = disc(SIZE, (106 + shift, 80), 50)
    for rendered, initial in ((TRUTH, aside), (aside, TRUTH)):
        assert iou(answer(TRUTH, rendered, initial)[0], TRUTH) > 0.95 > iou(aside, TRUTH)


def test_an_object_that_leaves_the_frame_is_answered_within_it():
    truth = disc(SIZE, (225, 80), 40)
    window = Window.around((185.0, 40.0, 55.0, 80.0), 0.5, 128)
    assert window.left + window.side > SIZE[1]
    mask, _ = answer(truth, truth, truth, window)
    assert mask.shape == SIZE
    assert iou(mask, truth) > 0.95


def test_what_of_the_silhouette_is_beyond_the_window_of_a_fragment_is_answered():
    fragment = disc(SIZE, (80, 60), 12)
    window = Window.around((68.0, 48.0, 24.0, 24.0), 0.3, 128)
    mask, _ = answer(TRUTH, TRUTH, fragment, window)
    assert iou(mask, TRUTH) > 0.9 > iou(fragment, TRUTH)


def test_an_empty_silhouette_beside_a_mask_is_no_traceback():
    nothing = np.zeros(SIZE, bool)
    assert answer(TRUTH, nothing, TRUTH)[0].any()
    mask, source = answer(TRUTH, nothing, nothing)
    assert not mask.any()
    assert source is MaskSource.INITIAL


def test_the_window_is_seen_at_twice_its_pixels():
    observation = observed(TRUTH, TRUTH)
    window, image, _ = upsampled_window(observation)
    assert image.shape == (256, 256, 3)
    assert (window.size, window.side) == (256, observation.window.side)
    assert image[128, 128, 0] > 150 > image[2, 128, 0]


def test_colours_of_a_frame_are_learnt():
    colours = update_colours(None, observed(TRUTH, TRUTH), TRUTH)
    assert colours is not None
    assert update_colours(colours, observed(TRUTH, TRUTH), np.zeros(SIZE, bool)) is colours


def test_the_answer_says_whether_it_is_more_than_the_input_handed_back():
    own = [source for source in MaskSource if source.is_own]
    assert own == [MaskSource.RENDERED, MaskSource.FUSED]


@pytest.mark.parametrize("confidence", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("cue", [None, 0.0])
def test_a_doubted_pose_redraws_nothing(confidence, cue):
    """Not even where its silhouette lies beyond the window, or where the motion cue tells nothing."""
    rendered, initial = disc(SIZE, (150, 80), 60), disc(SIZE, (104, 80), 47)
    seen = observed(TRUTH, initial)

    def moving():
        window, _, _ = upsampled_window(seen)
        return np.full((window.size, window.size), cue, np.float32)

    found = fuse_mask(rendered, initial, seen, confidence, None, None if cue is None else moving)
    np.testing.assert_array_equal(found.mask, initial)
    assert found.source is MaskSource.INITIAL


def test_what_moves_with_the_object_is_added_however_much_the_pose_is_doubted():
    """A side that turns into view: the pose is judged by a mask without it, and cannot be sure."""
    initial = TRUTH & (np.arange(SIZE[1]) < 130)
    seen = observed(TRUTH, initial)

    def moving():
        window, _, _ = upsampled_window(seen)
        return np.where(mask_in_window(TRUTH, window), 1, -1).astype(np.float32)

    found = fuse_mask(TRUTH, initial, seen, 0.1, None, moving)
    assert found.moving > 0.02
    assert iou(found.mask, TRUTH) > iou(initial, TRUTH) + 0.05


def test_a_pose_redraws_the_more_the_higher_its_confidence_is():
    initial = disc(SIZE, (113, 80), 50)
    changed = [
        int((answer(TRUTH, TRUTH, initial, confidence=confidence)[0] != initial).sum())
        for confidence in (0.5, 0.54, 0.6, 0.75)
    ]
    assert changed[0] == 0 < changed[2] < changed[3]
    assert changed == sorted(changed)
