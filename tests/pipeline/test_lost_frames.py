"""Frames in which the object was lost: the model is extended over them, or the video is tracked from another frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from resumable_runs import settings

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.evaluation.metrics import aligned_rotation_errors
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline import lost_frames, second_start
from tracking3d.pipeline.gap_tracker import plan_gaps
from tracking3d.pipeline.record import record
from tracking3d.pipeline.second_start import SecondStart
from tracking3d.pipeline.session import Session
from tracking3d.prompts.prompt import make_prompt
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.video import open_source

FRAMES = 16


@cache
def turning() -> SyntheticClip:
    return synthesize(
        SyntheticSpec(frames=FRAMES, size=(160, 120), degrees_per_frame=5.0, drift=(0.2, -0.1, 0.2))
    )


@pytest.mark.parametrize(
    ("unexplained", "backwards", "gaps"),
    [
        ({0, 1}, True, [(2, 2)]),
        ({0, 1}, False, []),
        ({3, 8, 9}, True, [(5, 2)]),
        ({3, 8, 9}, False, [(2, 1), (5, 4)]),
        ({4}, False, [(2, 2)]),
        (set(), True, []),
    ],
)
def test_gaps_begin_at_the_nearest_keyframe_and_end_with_the_last_unexplained_frame(
    unexplained, backwards, gaps
):
    assert list(plan_gaps(range(10), unexplained, {2, 5}, backwards)) == gaps


def test_frames_that_were_skipped_are_no_part_of_a_gap():
    assert list(plan_gaps([0, 2, 4, 7], {7}, {2}, backwards=False)) == [(2, 2)]


def tracked_from(start: int) -> tuple[Session, dict[int, np.ndarray], dict[int, float]]:
    """A session after its last frame, and what another start comes to."""
    clip = turning()
    session = Session(settings("tracker.name=masks"), make_prompt(mask=clip.masks[0]))
    for index, image in enumerate(clip.images):
        session.step(Frame(index, image))
    order = [*range(start, FRAMES), *range(start - 1, -1, -1)]
    frames = ((Frame(n, clip.images[n]), MaskEstimate(clip.masks[n].astype(np.float32))) for n in order)
    attempt = session.attempt(frames)
    assert attempt is not None
    session.adopt(attempt)
    return session, attempt.poses, attempt.confidence
