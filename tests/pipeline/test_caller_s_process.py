"""The process stays the caller's: its threads and random numbers are as before whenever its own code runs."""

from __future__ import annotations

import random

import cv2
import numpy as np
import pytest
import torch
from pydantic import BaseModel

from tracking3d import Frame, Session, load_config, track, track_objects
from tracking3d.config.models import PipelineConfig
from tracking3d.frames import MaskEstimate
from tracking3d.plugins import VARIABLE
from tracking3d.rendering.kernels import compilation as kernels
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.prompt import make_prompt

SETTINGS = [
    "crop.size=32",
    "object.frequency=2",
    "object.texture_size=16",
    "camera.fov=45",
    "runtime.threads=2",
]


class RestlessTracker:
    """A plug-in that draws from every global generator, and sets threads and seeds as it likes."""

    class Options(BaseModel):
        meddle: bool = False

    seen: list[tuple]

    def __init__(self, options: Options) -> None:
        self._options = options
        self.drawn()

    @classmethod
    def from_options(cls, options: BaseModel) -> RestlessTracker:
        return cls(cls.Options.model_validate(options.model_dump()))

    def drawn(self) -> tuple[float, float, float]:
        if self._options.meddle:
            torch.set_num_threads(5)
            cv2.setNumThreads(3)
            cv2.setRNGSeed(7)
        return random.random(), float(np.random.random()), float(torch.rand(()))

    def init(self, frame, prompt) -> MaskEstimate:
        self.mask = prompt.mask.astype(np.float32)
        return self.step(frame)

    def step(self, frame) -> MaskEstimate:
        self.seen.append((*self.drawn(), torch.get_num_threads(), kernels.get_num_threads()))
        return MaskEstimate(self.mask)


@pytest.fixture(scope="module")
def clip() -> SyntheticClip:
    return synthesize(SyntheticSpec(frames=3, size=(80, 64)))


@pytest.fixture
def config(monkeypatch) -> PipelineConfig:
    monkeypatch.setenv(VARIABLE, f"tracking3d.trackers:restless={__name__}:RestlessTracker")
    monkeypatch.setattr(RestlessTracker, "seen", [], raising=False)
    return load_config(overrides=SETTINGS, tracker="restless")


@pytest.fixture(autouse=True)
def restored():
    before = torch.get_num_threads(), kernels.get_num_threads(), cv2.getNumThreads()
    yield
    torch.set_num_threads(before[0])
    kernels.set_num_threads(before[1])
    cv2.setNumThreads(before[2])


@pytest.fixture
def mine():
    """Settings of the caller's own; what is returned tells what they are now."""
    torch.set_num_threads(3)
    kernels.set_num_threads(4)
    cv2.setNumThreads(2)
    random.seed(1)
    np.random.seed(1)
    torch.manual_seed(1)

    def settings() -> tuple:
        numbers = np.random.get_state()[1].tobytes(), torch.get_rng_state().numpy().tobytes()
        counts = torch.get_num_threads(), kernels.get_num_threads(), cv2.getNumThreads()
        return counts, random.getstate(), *numbers

    return settings


def test_between_frames_and_at_the_end_everything_is_the_caller_s(clip, config, mine):
    before = mine()
    for _ in track(clip.images, mask=clip.masks[0], config=config):
        assert mine() == before
    assert mine() == before


def test_a_generator_that_is_left_in_the_middle_leaves_nothing_behind(clip, config, mine):
    before = mine()
    estimates = track(clip.images, mask=clip.masks[0], config=config)
    next(estimates)
    del estimates
    assert mine() == before
    with pytest.raises(ZeroDivisionError):
        for _ in track_objects(clip.images, masks=[clip.masks[0]] * 2, config=config):
            raise ZeroDivisionError
    assert mine() == before


def test_a_session_keeps_to_itself_whatever_it_is_asked_for(clip, config, mine):
    before = mine()
    first = Frame(0, clip.images[0])
    session = Session(config, make_prompt(first, mask=clip.masks[0]))
    assert mine() == before
    session.step(first)
    session.result()
    session.refine()
    assert mine() == before


def test_a_plugin_that_sets_threads_and_seeds_sets_them_for_itself(clip, config, mine):
    before = mine()
    config = load_config(overrides=[*SETTINGS, "tracker.meddle=true"], tracker="restless")
    list(track(clip.images, mask=clip.masks[0], config=config))
    assert mine() == before


def test_a_frame_that_cannot_be_used_leaves_everything_as_it_was(clip, config, mine):
    before = mine()
    with pytest.raises(Exception, match="Frame 1"):
        list(track([clip.images[0], None], mask=clip.masks[0], config=config))
    assert mine() == before


def test_at_work_the_threads_are_those_of_the_configuration(clip, config, mine):
    list(track(clip.images, mask=clip.masks[0], config=config))
    assert {counts for *_, counts_of_torch, counts in RestlessTracker.seen} == {2}
    assert {of_torch for *_, of_torch, _ in RestlessTracker.seen} == {1}  # Numba renders, and has them all


def test_the_seed_makes_a_plugin_s_random_numbers_repeatable_whatever_the_caller_draws(clip, config):
    def drawn(disturb: bool, **runtime: int) -> list[tuple]:
        RestlessTracker.seen = []
        chosen = load_config(overrides=SETTINGS, tracker="restless", runtime=runtime)
        for _ in track(clip.images, mask=clip.masks[0], config=chosen):
            if disturb:
                torch.rand(11), np.random.random(5), random.random()
                torch.manual_seed(99)
        return RestlessTracker.seen

    quiet = drawn(False)
    assert drawn(True) == quiet
    assert len(set(quiet)) == 3
    assert drawn(False, seed=1) != quiet


def test_two_sessions_side_by_side_answer_as_one_alone_does(clip, config):
    alone = list(track(clip.images, mask=clip.masks[0], config=config))
    numbers = list(RestlessTracker.seen)
    RestlessTracker.seen = []
    both = [track(clip.images, mask=clip.masks[0], config=config) for _ in range(2)]
    for expected, one, other in zip(alone, *both, strict=True):
        np.testing.assert_array_equal(one.T_cam_obj, expected.T_cam_obj)
        np.testing.assert_array_equal(other.T_cam_obj, expected.T_cam_obj)
    assert RestlessTracker.seen[::2] == RestlessTracker.seen[1::2] == numbers
