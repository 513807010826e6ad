"""A lost object that comes back by a side that nobody knows is tracked anew, and joined when a side is known."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from online_runs import estimate_of, final

from tracking3d.checkpoint.trees import TreeFolder
from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import GUESSED, MaskSource, Status
from tracking3d.estimation.online.anew import (
    adopted,
    doubted,
    guess,
    is_whole,
    largest_of,
    looks_alike,
    of_frame,
    of_one_thing,
    refined_aside,
)
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.evaluation.metrics import aligned_rotation_errors
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.similarity import Similarity
from tracking3d.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize

FIRST, HIDDEN = 12, 3
SECOND = range(30, 84)
"""Images of the clip: twelve, which show 60 degrees, then nothing, then from 150 to 415 degrees."""
SHOWN = [*range(FIRST), *[None] * HIDDEN, *SECOND]
BACK = FIRST + HIDDEN
"""The frame in which the object is seen again."""
ALONE = BACK + 22
"""The frames until then show no side of before."""


@cache
def clip() -> SyntheticClip:
    """A box with cut corners that turns all the way round, 5 degrees a frame."""
    return synthesize(
        SyntheticSpec(frames=SECOND.stop, size=(240, 180), degrees_per_frame=5.0, drift=(0.2, -0.1, 0.2))
    )


@cache
def solver() -> OnlineSolver:
    """With the default settings, but for a shape of fewer vertices."""
    config = load_config(preset="default", overrides=["object.frequency=7"])
    return OnlineSolver(config, clip().camera, RgbEncoder())


def shown(index: int) -> tuple[Frame, np.ndarray | None]:
    image = SHOWN[index]
    if image is None:
        return Frame(index, np.full_like(clip().images[0], 120)), None
    return Frame(index, clip().images[image]), clip().masks[image]


@cache
def run(count: int):
    """The state after so many frames, and the answers as they came; each frame is solved once for all tests."""
    frame, mask = shown(count - 1)
    if count == 1:
        state, answer = solver().init(frame, estimate_of(mask))
        return state, (answer,)
    state, answers = run(count - 1)
    state, answer = solver().step(state, frame, estimate_of(mask))
    return state, (*answers, answer)


@cache
def refined(count: int):
    """The state after the final refinement of so many frames, and their answers once more."""
    state, answers = run(count)
    state, found = solver().refine(state), []
    for answer in final(answers):
        frame, mask = shown(answer.index)
        state, again = solver().revisit(state, frame, estimate_of(mask), answer.T_cam_obj)
        found.append(again)
    return state, found


def rotation_errors(answers) -> np.ndarray:
    """In degrees, of those that have a pose, be it a guess how that lies to others."""
    seen = [answer for answer in answers if answer.status is not Status.LOST or GUESSED in answer.losses]
    found = np.stack([answer.T_cam_obj[:3, :3] for answer in seen])
    true = clip().T_cam_obj[[SHOWN[answer.index] for answer in seen], :3, :3]
    return aligned_rotation_errors(found, true)


def test_a_side_that_nobody_knows_is_tracked_anew_and_said_to_lie_there_by_a_guess():
    state, answers = run(ALONE)
    second = final(answers)[BACK:]
    assert state.guessed and len(state.aside) == 1
    assert all(answer.status is Status.LOST and GUESSED in answer.losses for answer in second[1:])
    assert all("re-initialized" in answer.reason and answer.confidence <= 0.05 for answer in second[1:])
    # Its masks are its own.
    assert all(answer.mask_source is not MaskSource.INITIAL for answer in second[-5:])
    assert rotation_errors(second).mean() < 4
    # Until the second start is solved nothing is known, and it is as large as it was.
    assert GUESSED not in answers[BACK].losses
    before, after = (np.linalg.norm(answer.T_cam_obj[:3, 3]) for answer in (answers[5], answers[-1]))
    assert after == pytest.approx(before, rel=0.3)


def test_when_a_known_side_is_met_again_both_maps_are_one():
    state, answers = run(len(SHOWN))
    assert not state.aside and not state.guessed
    assert {SHOWN.index(0), BACK + 30} & {view.index for view in state.known.keyframes}
    assert any(view.index < FIRST for view in state.known.keyframes)
    assert any(BACK <= view.index < ALONE for view in state.known.keyframes)
    last = answers[-1]
    assert last.status is Status.TRACKED and GUESSED not in last.losses
    assert rotation_errors([*answers[3:FIRST], last])[-1] < 6


def test_the_final_refinement_puts_all_frames_of_joined_maps_right():
    _, answers = refined(len(SHOWN))
    seen = [answer for answer in answers if SHOWN[answer.index] is not None]
    assert not any(GUESSED in answer.losses for answer in seen)
    assert np.median(rotation_errors(seen)) < 3


def test_maps_that_were_never_joined_are_refined_each_by_itself():
    state, answers = refined(ALONE)
    first, second = answers[:FIRST], answers[BACK:]
    assert rotation_errors(first).mean() < 4 and rotation_errors(second).mean() < 4
    # Of the larger the mesh is made; how the other lies to it is a guess.
    sizes = {len(state.known.keyframes), *(len(other.known.keyframes) for other in state.aside)}
    assert len(largest_of(state).known.keyframes) == max(sizes)
    guessed = {GUESSED in answer.losses for answer in first}, {GUESSED in answer.losses for answer in second}
    assert sorted(guessed, key=sorted) == [{False}, {True}]
    mesh = solver().result(state)
    assert np.array_equal(mesh.vertices, largest_of(state).known.vertices.numpy())


def test_a_frame_that_stays_lost_stays_where_it_was_taken_to_be():
    _, causal = run(ALONE)
    _, answers = refined(ALONE)
    for before, after in list(zip(final(causal), answers, strict=True))[FIRST:BACK]:
        assert before.status is after.status is Status.LOST and GUESSED not in after.losses
        assert np.allclose(after.T_cam_obj, before.T_cam_obj, atol=1e-5)


def test_each_frame_is_looked_at_again_with_the_map_that_answered_it():
    state, _ = refined(ALONE)
    first, second = (of_frame(state, index).known for index in (2, ALONE - 1))
    assert first.keyframes[0].index < FIRST and second.keyframes[0].index >= BACK
    # Whichever map is at hand, the other is found.
    assert of_frame(of_frame(state, 2), ALONE - 1).known is second
    assert of_frame(of_frame(state, ALONE - 1), 2).known is first


@pytest.mark.parametrize("count", [BACK + 4, ALONE])
def test_a_run_that_is_stopped_meanwhile_goes_on_as_if_it_had_not_been(count, tmp_path):
    state, _ = run(count)
    assert state.anew or state.aside
    written = TreeFolder(tmp_path, solver().state_classes).text(state)
    kept = TreeFolder(tmp_path, solver().state_classes).read(json.loads(written))
    frame, mask = shown(count)
    _, expected = solver().step(state, frame, estimate_of(mask))
    _, answer = solver().step(kept, frame, estimate_of(mask))
    assert np.array_equal(answer.T_cam_obj, expected.T_cam_obj) and answer.status is expected.status


def test_a_map_that_stands_aside_goes_through_the_lens_of_the_end():
    state, _ = run(ALONE)
    before = state.camera
    after = before.zoomed(1.2, "solved")
    other = refined_aside(state.aside[0], before, after, solver().online)
    # The first keyframe's pose moves with the lens alone.
    (x, y, z), (u, v, w) = (
        one.known.keyframes[0].pose.translation.tolist() for one in (state.aside[0], other)
    )
    assert (u, v, w) == pytest.approx((x, y, 1.2 * z))
    assert other.guessed and other.spans == state.aside[0].spans


def test_the_guess_goes_on_turning_and_keeps_the_size():
    state, _ = run(FIRST)
    similarity = guess(state, state)
    assert similarity.scale == pytest.approx(1.0)
    # A start from the map itself lies where the motion leads at its keyframes.
    assert np.linalg.det(similarity.R) == pytest.approx(1.0)
    assert np.degrees(np.arccos((np.trace(similarity.R) - 1) / 2)) < 60


def test_of_many_maps_only_the_larger_ones_stand_aside():
    state, _ = run(ALONE)
    small = replace(state.aside[0], known=replace(state.aside[0].known, keyframes=()))
    large = [replace(state.aside[0], spans=((n, n),)) for n in range(5)]
    lost, _ = run(FIRST)
    lost = replace(lost, aside=(large[0], small, *large[1:3]))
    now = adopted(lost, state, Similarity(np.eye(3), 1.0, np.zeros(3)))
    assert [other.spans[0][0] for other in now.aside[:3]] == [0, 1, 2] and len(now.aside) == 4
    assert now.aside[-1].known is lost.known and now.guessed


def test_what_is_lost_is_not_doubted_as_well():
    _, answers = run(BACK + 1)
    assert doubted(answers[-1]) is answers[-1]
    sure = replace(answers[5], status=Status.TRACKED, confidence=0.9)
    assert doubted(sure).status is Status.LOST and doubted(sure).confidence < 0.1


def test_masks_are_of_one_thing_if_they_overlap():
    left, right, middle = (np.zeros((20, 30), bool) for _ in range(3))
    left[5:15, 2:12], right[5:15, 18:28], middle[5:15, 5:15] = True, True, True
    assert of_one_thing(left, left) and of_one_thing(left, middle)
    assert not of_one_thing(left, right) and not of_one_thing(None, left)


@pytest.mark.parametrize("side", [np.s_[:3, 5:9], np.s_[-3:, 5:9], np.s_[5:9, :3], np.s_[5:9, -3:]])
def test_what_comes_in_over_the_border_is_not_whole(side):
    mask = np.zeros((20, 30), bool)
    assert not is_whole(mask)
    mask[5:9, 5:9] = True
    assert is_whole(mask)
    mask[side] = True
    assert not is_whole(mask)


def test_what_has_the_colours_of_the_surroundings_is_not_the_object():
    state, _ = run(FIRST)
    image, mask = clip().images[40], clip().masks[40]
    assert state.colours is not None and looks_alike(state, Frame(BACK, image), mask)
    wall = np.zeros_like(mask)
    wall[2:20, 2:20] = True
    assert not mask[wall].any() and not looks_alike(state, Frame(BACK, image), wall)
