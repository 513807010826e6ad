"""What is in front of the object is known with every mask tracker: the network of `segment` says it for the others."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d.config.models import PluginChoice
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.plugins.guard import GuardedTracker
from tracking3d.testing.trackers import moving_disc
from tracking3d.trackers.segment.network import ObjectNetwork

HAND = np.zeros((90, 120), bool)
HAND[60:, :40] = True


@pytest.fixture
def asked(monkeypatch) -> list[np.ndarray]:
    """The masks for which the network was asked; it sees a hand in every frame."""
    masks: list[np.ndarray] = []

    def occluder(self, image, mask):
        masks.append(mask)
        return HAND

    monkeypatch.setattr(ObjectNetwork, "occluder", occluder)
    return masks


def prompted(name: str) -> tuple[PromptedTracker, tuple[Frame, ...]]:
    clip = moving_disc((90, 120), 3)
    return PromptedTracker(PluginChoice(name=name), clip.prompt(True)), clip.frames


@pytest.mark.parametrize("name", ["csrt", "flow"])
def test_a_tracker_that_cannot_tell_gets_its_occluder_from_the_network(asked, name: str):
    tracker, frames = prompted(name)
    estimates = [tracker.start(frames[0]), tracker.step(frames[1])]
    for estimate, mask in zip(estimates, asked, strict=True):
        assert estimate.occluder is HAND
        np.testing.assert_array_equal(mask, estimate.binary)


def test_the_object_given_again_in_a_later_frame_gets_one_too(asked):
    tracker, frames = prompted("flow")
    tracker.start(frames[0])
    assert tracker.step(frames[1], Prompt((40.0, 25.0, 40.0, 40.0))).occluder is HAND


@pytest.mark.parametrize("own", [HAND, HAND & False])
def test_the_occluder_of_a_tracker_that_reports_one_is_kept(asked, monkeypatch, own: np.ndarray):
    tracker, frames = prompted("flow")
    full = np.ones((90, 120), np.float32)
    monkeypatch.setattr(GuardedTracker, "init", lambda self, frame, prompt: MaskEstimate(full, occluder=own))
    assert tracker.start(frames[0]).occluder is own
    assert not asked


def test_without_a_mask_nothing_is_asked(asked, monkeypatch):
    tracker, frames = prompted("flow")
    nothing = MaskEstimate(None, 0.0, "gone")
    monkeypatch.setattr(GuardedTracker, "init", lambda self, frame, prompt: nothing)
    assert tracker.start(frames[0]) is nothing
    assert not asked
