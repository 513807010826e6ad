"""Frames in which the object was lost: the model is extended over them, or the video is tracked from another frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from resumable_runs import settings

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline import lost_frames
from tracking3d.pipeline.lost_frames import SecondStart, may_win, plan_gaps
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import Session
from tracking3d.results.files import write_image
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d.trackers.prompts.prompt import make_prompt
from tracking3d.video import open_source
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

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
    first = Frame(0, clip.images[0])
    session = Session(settings("crop.size=64", "object.frequency=5"), make_prompt(first, mask=clip.masks[0]))
    for index, image in enumerate(clip.images):
        session.step(Frame(index, image))
    order = [*range(start, FRAMES), *range(start - 1, -1, -1)]
    frames = ((Frame(n, clip.images[n]), MaskEstimate(clip.masks[n].astype(np.float32))) for n in order)
    attempt = session.attempt(frames)
    assert attempt is not None
    session.adopt(attempt)
    return session, attempt.poses, attempt.confidence


def test_another_start_estimates_every_frame_both_ways_and_is_refined_in_order_of_time():
    session, poses, confidence = tracked_from(6)
    clip = turning()
    assert sorted(poses) == sorted(confidence) == list(range(FRAMES))
    assert rotation_errors(poses).max() < 8
    session.refine()
    refined = {}
    for index, image in enumerate(clip.images):
        mask = MaskEstimate(clip.masks[index].astype(np.float32))
        refined[index] = session.refine_frame(Frame(index, image), mask, poses[index]).T_cam_obj
    assert rotation_errors(refined).max() < 5


def rotation_errors(poses) -> np.ndarray:
    found = np.stack([poses[index][:3, :3] for index in range(FRAMES)])
    return aligned_rotation_errors(found, turning().T_cam_obj[:, :3, :3])


@pytest.fixture
def video(tmp_path):
    """A folder of images, which `run` takes as a video."""
    folder = tmp_path / "frames"
    folder.mkdir()
    for index, image in enumerate(turning().images):
        write_image(folder / f"{index:06d}.png", image)
    return folder


def lose(monkeypatch, frames) -> None:
    """The solver loses the object in these frames while they come causally, and finds it in the next one."""
    step = OnlineSolver.step

    def losing(self, state, frame, mask):
        after, estimate = step(self, state, frame, mask)
        if frame.index not in frames:
            return after, estimate
        state = replace(state, last_pose=(state.last_pose[0], frame.index), grey=after.grey)
        return state, replace(estimate, status=Status.LOST, reason="lost for this test", confidence=0.05)

    monkeypatch.setattr(OnlineSolver, "step", losing)


def run(video, folder) -> RunReader:
    record(
        open_source(str(video), fps=30),
        settings("crop.size=64", "object.frequency=5"),
        folder,
        mask=turning().masks[0],
    )
    return RunReader(folder)


def test_frames_that_were_lost_are_found_from_both_sides_before_the_refinement(monkeypatch, tmp_path, video):
    lose(monkeypatch, {12, 13, 14, 15})
    given = {}
    start_from = OnlineSolver.start_from
    monkeypatch.setattr(
        OnlineSolver,
        "start_from",
        lambda self, state, poses: given.update(poses) or start_from(self, state, poses),
    )
    reader = run(video, tmp_path / "run")
    refined, tried = reader.frames, reader.description["refinement"]["start"]["tried"]
    assert {12, 13, 14, 15} <= set(given)
    assert list(tried) == ["gaps"] and 4 <= tried["gaps"] <= FRAMES
    assert rotation_errors({one.index: one.T_cam_obj for one in refined}).max() < 8


@pytest.mark.slow
def test_a_run_in_which_hardly_a_frame_was_lost_is_refined_as_it_is(monkeypatch, tmp_path, video):
    monkeypatch.setattr(lost_frames, "GapTracker", lambda *given: pytest.fail("nothing was lost"))
    run(video, tmp_path / "run")


@pytest.mark.slow
def test_a_second_start_is_made_if_a_quarter_is_left_and_adopted_only_if_it_explains_more(
    monkeypatch, tmp_path, video, caplog
):
    lose(monkeypatch, set(range(4, FRAMES)))
    monkeypatch.setattr(lost_frames, "find_start", lambda source, masks: 5)
    monkeypatch.setattr(Session, "adopt", lambda *given: pytest.fail("it explains fewer"))
    monkeypatch.setattr(SecondStart, "is_better", False)
    monkeypatch.setattr(OnlineSolver, "begin_extension", lambda *given: None)
    with caplog.at_level("INFO"):
        run(video, tmp_path / "run")
    assert "A start in frame 5 explains" in caplog.text


@pytest.mark.slow
def test_gaps_take_no_more_frames_than_are_left(monkeypatch, tmp_path, video):
    monkeypatch.setattr(Session, "tried", FRAMES - 2)
    monkeypatch.setattr(lost_frames, "find_start", lambda *_: pytest.fail("no frames are left for it"))
    lose(monkeypatch, {9, 10, 11, 12, 13, 14, 15})
    tried = run(video, tmp_path / "run").description["refinement"]["start"]["tried"]
    assert tried == {"while tracking": FRAMES - 2, "gaps": 2}


@pytest.mark.parametrize(
    ("explained", "shown", "left", "goes_on"),
    [
        (0, 10, 5, True),  # there is no map yet
        (0, 10, 0, False),
        (10, 15, 5, True),
        (2, 15, 5, False),  # with the other five it would not be enough
        (6, 10, 0, True),  # the first start explains five of these ten
        (5, 10, 0, False),
    ],
)
def test_a_second_start_ends_when_it_cannot_win_or_is_behind_at_the_end_of_the_budget(
    explained, shown, left, goes_on
):
    before = {n: float(n % 2) for n in range(20)}
    now = {n: float(n < explained) for n in range(shown)}
    assert may_win(now, before, 20, left) is goes_on


@pytest.mark.parametrize(("shown", "frames", "goes_on"), [(60, 100, True), (61, 100, False), (75, 300, True)])
def test_a_second_start_ends_when_it_has_explained_none_for_long(shown, frames, goes_on):
    assert may_win(dict.fromkeys(range(shown), 0.3), {}, frames, 5) is goes_on


def test_a_second_start_without_points_ends_with_its_map_if_the_first_had_none_either():
    assert not may_win(dict.fromkeys(range(9), 0.3), {}, 100, 50, without_points=True)
    assert may_win(dict.fromkeys(range(9), 0.9), {}, 100, 50, without_points=True)


@pytest.mark.parametrize(("explained", "better"), [(11, False), (12, True), (3, False)])
def test_a_second_start_must_explain_clearly_more(explained, better):
    assert SecondStart(4, explained, 10).is_better is better


@pytest.mark.slow
def test_run_json_says_where_the_refined_model_started_and_why(monkeypatch, tmp_path, video):
    first = run(video, tmp_path / "first").description["refinement"]["start"]
    assert first == {"frame": 0, "reason": "tracking began in this frame"}
    lose(monkeypatch, set(range(4, FRAMES)))
    monkeypatch.setattr(lost_frames, "find_start", lambda source, masks: 5)
    monkeypatch.setattr(SecondStart, "is_better", True)
    monkeypatch.setattr(OnlineSolver, "begin_extension", lambda *given: None)
    second = run(video, tmp_path / "second")
    start = second.description["refinement"]["start"]
    assert start["frame"] == 5
    assert f"of {FRAMES} frames, one in frame 0 explains" in start["reason"]
    assert [one.index for one in second.frames] == list(range(FRAMES))
