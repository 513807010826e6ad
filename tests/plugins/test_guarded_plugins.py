"""A guarded plug-in does what the bare one does; what goes wrong in it carries its name."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.nn import functional

from tracking3d.errors import InputError, PluginError
from tracking3d.features.protocol import Keypoints
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.plugins.guard import (
    GuardedDetector,
    GuardedEncoder,
    GuardedTracker,
    PluginFailure,
    feature_fault,
    mask_fault,
)

FRAME = Frame(3, np.zeros((4, 6, 3), np.uint8))
PROMPT = Prompt((1.0, 1.0, 2.0, 2.0))


class Tracker:
    def __init__(self, answer) -> None:
        self.answer = answer

    def init(self, frame, prompt):
        return self.step(frame)

    def step(self, frame):
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer


class Encoder:
    channels, stride, tau = 3, 4, 0.1
    weights = "small"

    def encode(self, images):
        assert not torch.is_grad_enabled()
        return functional.avg_pool2d(images, 4)

    def prepare(self, image):
        raise KeyError(image)


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.float64, np.float32])
def test_masks_of_ones_and_zeros_become_float32(dtype):
    mask = np.eye(4, 6).astype(dtype)
    answer = GuardedTracker(Tracker(MaskEstimate(mask, 1, "so")), "mine").init(FRAME, PROMPT)
    assert answer.mask.dtype == np.float32
    np.testing.assert_array_equal(answer.mask, mask)
    assert (answer.score, answer.reason) == (1.0, "so")


def test_an_answer_without_a_mask_is_one():
    answer = GuardedTracker(Tracker(MaskEstimate(None, 0.0, "gone")), "mine").step(FRAME)
    assert (answer.mask, answer.reason) == (None, "gone")


@pytest.mark.parametrize("score", [-0.1, 1.1, float("inf"), "high", None])
def test_a_score_is_a_number_from_0_to_1(score):
    assert "score" in mask_fault(MaskEstimate(None, score), (4, 6))


@pytest.mark.parametrize("occluder", [np.zeros((4, 6)), np.zeros((4, 5), bool), "hand"])
def test_an_occluder_is_a_bool_array_of_the_frame_s_size(occluder):
    assert "occluder" in mask_fault(MaskEstimate(None, 0.5, "so", occluder), (4, 6))


def test_an_occluder_is_passed_on():
    hand = np.eye(4, 6) > 0
    answer = GuardedTracker(Tracker(MaskEstimate(np.zeros((4, 6)), 0.5, "so", hand)), "mine").step(FRAME)
    np.testing.assert_array_equal(answer.occluder, hand)


def test_what_the_user_got_wrong_is_told_unchanged_at_the_start_only():
    tracker = GuardedTracker(Tracker(InputError("The box is too small; give another.")), "mine")
    with pytest.raises(InputError, match=r"^The box is too small"):
        tracker.init(FRAME, PROMPT)
    with pytest.raises(PluginFailure, match=r"^mine failed: The box is too small; give another\.$"):
        tracker.step(FRAME)


def test_a_failure_can_be_told_with_its_frame():
    with pytest.raises(PluginFailure) as caught:
        GuardedTracker(Tracker(ValueError("two\nlines.")), "mine").step(FRAME)
    assert str(caught.value.at("frame 3")) == "mine failed at frame 3: ValueError: two lines."
    assert caught.value.reason == "mine failed: ValueError: two lines"


def test_ctrl_c_is_nobodys_fault():
    with pytest.raises(KeyboardInterrupt):
        GuardedTracker(Tracker(KeyboardInterrupt()), "mine").step(FRAME)


def test_an_encoder_keeps_its_attributes_and_its_methods_are_guarded_too():
    guarded = GuardedEncoder(Encoder(), "mine")
    assert (guarded.channels, guarded.stride, guarded.tau, guarded.weights) == (3, 4, 0.1, "small")
    assert not hasattr(guarded, "compile")
    with pytest.raises(PluginFailure, match=r"mine failed: KeyError: 7"):
        guarded.prepare(7)


def test_an_encoder_runs_without_gradients_and_its_features_carry_none():
    images = torch.rand(2, 3, 8, 8, requires_grad=True)
    features = GuardedEncoder(Encoder(), "mine").encode(images)
    assert not features.requires_grad
    assert torch.is_grad_enabled()


@pytest.mark.parametrize(
    ("height", "width", "fits"), [(2, 2, True), (3, 3, True), (2, 3, True), (1, 2, False), (3, 4, False)]
)
def test_features_may_be_rounded_up_or_down_where_the_stride_does_not_divide_the_size(height, width, fits):
    fault = feature_fault(torch.zeros(1, 3, height, width), torch.zeros(1, 3, 10, 10), Encoder())
    assert (not fault) == fits


@pytest.mark.parametrize("height", [1, 3])
def test_features_have_the_one_size_where_the_stride_divides_it(height):
    assert feature_fault(torch.zeros(1, 3, height, 2), torch.zeros(1, 3, 8, 8), Encoder())


@pytest.mark.parametrize(
    ("name", "value"),
    [("channels", 2.5), ("channels", True), ("stride", -1), ("tau", "0.2"), ("tau", float("nan"))],
)
def test_attributes_that_are_no_positive_numbers_are_refused(name, value):
    encoder = Encoder()
    setattr(encoder, name, value)
    with pytest.raises(PluginError, match=f"mine is broken: its {name} is"):
        GuardedEncoder(encoder, "mine")


@pytest.mark.parametrize(
    ("found", "fault"),
    [
        (None, "None instead of Keypoints"),
        (Keypoints(np.zeros((3, 2)), np.zeros((2, 8))), r"pixels have shape \(3, 2\)"),
        (Keypoints(np.full((3, 2), np.nan), np.zeros((3, 8))), "not finite"),
        (Keypoints(np.full((3, 2), 99.0), np.zeros((3, 8))), "in the picture"),
    ],
)
def test_keypoints_that_violate_the_protocol_are_told(found, fault):
    detector = SimpleNamespace(rotation_invariant=True, detect=lambda *_: found)
    with pytest.raises(PluginFailure, match=fault):
        GuardedDetector(detector, "it").detect(np.zeros((40, 60), np.uint8), np.ones((40, 60), bool), 9, 1.0)


def test_keypoints_that_keep_to_the_protocol_are_passed_on():
    found = Keypoints(np.array([[59.4, 39.4]]), np.ones((1, 8)))
    guarded = GuardedDetector(SimpleNamespace(rotation_invariant=False, detect=lambda *_: found), "it")
    assert guarded.detect(np.zeros((40, 60), np.uint8), np.ones((40, 60), bool), 9, 1.0) is found
    assert guarded.rotation_invariant is False
