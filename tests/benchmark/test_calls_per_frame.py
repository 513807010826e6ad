"""What a frame costs, counted in function calls: the same on every machine, unlike seconds.

Two fifths of a frame's time is compiled work, the rest follows the number of calls. The limits are a quarter above what
was counted when they were set; what exceeds them has become slower, and what is far below should lower them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import Status
from tracking3d.frames import Frame, Prompt
from tracking3d.pipeline.session import Session
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.trackers.crops import box_of

pytestmark = pytest.mark.slow
FRAMES, SETTLED = 48, 36
CAUSAL, REFINED = 18_000, 4_900
"""Calls of the main thread: a tracked frame's median, and that of a frame in the second pass."""


def count_calls(step: Callable[[], object]) -> int:
    """Functions, Python's and built-in ones, that are called in ``step``."""
    calls = 0

    def count(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        step()
    finally:
        sys.setprofile(None)
    return calls


@pytest.fixture(scope="module")
def counts() -> tuple[list[int], list[int]]:
    """Calls for each frame as it is tracked, and as it is estimated again with the final map."""
    clip = synthesize(SyntheticSpec(frames=FRAMES, size=(320, 240), degrees_per_frame=3.0))
    frames = [Frame(index, image, index / 30) for index, image in enumerate(clip.images)]
    box = box_of(clip.masks[0])
    assert box is not None
    session = Session(load_config(tracker={"name": "csrt"}), Prompt(box, clip.masks[0]))
    causal, refined, known = [], [], []

    def track(frame: Frame) -> None:
        estimate = session.step(frame)
        known.append((frame, session.initial_mask, estimate))

    for frame in frames:
        causal.append(count_calls(partial(track, frame)))
    assert known[-1][2].status is Status.TRACKED
    session.refine()
    for frame, mask, estimate in known:
        refined.append(count_calls(partial(session.refine_frame, frame, mask, estimate.T_cam_obj)))
    return causal, refined


def test_a_frame_that_is_tracked(counts):
    assert np.median(counts[0][SETTLED:]) < CAUSAL


def test_a_frame_that_is_estimated_again(counts):
    assert np.median(counts[1]) < REFINED


def test_counting_counts():
    assert count_calls(lambda: [abs(-1) for _ in range(10)]) >= 10
