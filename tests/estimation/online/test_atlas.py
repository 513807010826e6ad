"""A lost object that comes back by an unseen side gets a second map, which is merged when a known side is seen."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from online_runs import estimate_of, final

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import UNALIGNED_MAP, MaskSource, Status
from tracking3d.estimation.online import tracker
from tracking3d.estimation.online.atlas import (
    activate_largest_map,
    colours_match,
    guess_alignment,
    is_fully_visible,
    map_of_frame,
    mark_unaligned,
    masks_overlap,
    needs_second_map,
    refine_inactive_map,
    switch_map,
)
from tracking3d.estimation.online.features.klt import grey
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.solver_state import MaskAgreement
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import Frame
from tracking3d.geometry.similarity import Similarity
from tracking3d.results.checkpoint.serialization import TreeFolder
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

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
        state, estimate = solver().init(frame, estimate_of(mask))
        return state, (estimate,)
    state, estimates = run(count - 1)
    state, estimate = solver().step(state, frame, estimate_of(mask))
    return state, (*estimates, estimate)


@cache
def refined(count: int):
    """The state after the final refinement of so many frames, and their answers once more."""
    state, estimates = run(count)
    state, found = solver().refine(state), []
    for estimate in final(estimates):
        frame, mask = shown(estimate.index)
        state, again = solver().refine_frame(state, frame, estimate_of(mask), estimate.T_cam_obj)
        found.append(again)
    return state, found


def rotation_errors(estimates) -> np.ndarray:
    """In degrees, of those that have a pose, be it a guess how that lies to others."""
    seen = [
        estimate
        for estimate in estimates
        if estimate.status is not Status.LOST or UNALIGNED_MAP in estimate.diagnostics
    ]
    found = np.stack([estimate.T_cam_obj[:3, :3] for estimate in seen])
    true = clip().T_cam_obj[[SHOWN[estimate.index] for estimate in seen], :3, :3]
    return aligned_rotation_errors(found, true)


def test_while_an_object_stays_lost_frames_with_a_mask_are_searched_as_a_whole_at_intervals(monkeypatch):
    (state, _), searched = run(FIRST), list[int]()
    monkeypatch.setattr(tracker, "relocalize_in_frame", lambda *_: searched.append(state.lost_frames))
    blank, mask = np.full_like(clip().images[0], 120), estimate_of(shown(FIRST - 1)[1])
    for index in range(FIRST, FIRST + 17):
        state, estimate = solver().step(state, Frame(index, blank), mask)
    assert estimate.status is Status.LOST and state.lost_frames > 15
    assert searched[-7:] == [1, 2, 3, 4, 5, 10, 15]


def test_a_side_that_nobody_knows_is_tracked_anew_and_said_to_lie_there_by_a_guess():
    state, estimates = run(ALONE)
    second = final(estimates)[BACK:]
    assert state.unaligned and len(state.inactive_maps) == 1
    assert all(
        estimate.status is Status.LOST and UNALIGNED_MAP in estimate.diagnostics for estimate in second[1:]
    )
    assert all("re-initialized" in estimate.reason and estimate.confidence <= 0.05 for estimate in second[1:])
    # Its masks are its own.
    assert all(estimate.mask_source is not MaskSource.INITIAL for estimate in second[-5:])
    assert rotation_errors(second).mean() < 4
    # Until the second start is solved nothing is known, and it is as large as it was.
    assert UNALIGNED_MAP not in estimates[BACK].diagnostics
    before, after = (np.linalg.norm(estimate.T_cam_obj[:3, 3]) for estimate in (estimates[5], estimates[-1]))
    assert after == pytest.approx(before, rel=0.3)


def test_when_a_known_side_is_met_again_both_maps_are_one():
    state, estimates = run(len(SHOWN))
    assert not state.inactive_maps and not state.unaligned
    assert {SHOWN.index(0), BACK + 30} & {view.index for view in state.object_map.keyframes}
    assert any(view.index < FIRST for view in state.object_map.keyframes)
    assert any(BACK <= view.index < ALONE for view in state.object_map.keyframes)
    last = estimates[-1]
    assert last.status is Status.TRACKED and UNALIGNED_MAP not in last.diagnostics
    assert rotation_errors([*estimates[3:FIRST], last])[-1] < 6


def test_the_final_refinement_puts_all_frames_of_joined_maps_right():
    _, estimates = refined(len(SHOWN))
    seen = [estimate for estimate in estimates if SHOWN[estimate.index] is not None]
    assert not any(UNALIGNED_MAP in estimate.diagnostics for estimate in seen)
    assert np.median(rotation_errors(seen)) < 3


def test_maps_that_were_never_joined_are_refined_each_by_itself():
    state, estimates = refined(ALONE)
    first, second = estimates[:FIRST], estimates[BACK:]
    assert rotation_errors(first).mean() < 4 and rotation_errors(second).mean() < 4
    # Of the larger the mesh is made; how the other lies to it is a guess.
    sizes = {
        len(state.object_map.keyframes),
        *(len(other.object_map.keyframes) for other in state.inactive_maps),
    }
    assert len(activate_largest_map(state).object_map.keyframes) == max(sizes)
    guessed = (
        {UNALIGNED_MAP in estimate.diagnostics for estimate in first},
        {UNALIGNED_MAP in estimate.diagnostics for estimate in second},
    )
    assert sorted(guessed, key=sorted) == [{False}, {True}]
    mesh = solver().result(state)
    assert np.array_equal(mesh.vertices, activate_largest_map(state).object_map.vertices.numpy())


def test_a_frame_that_stays_lost_stays_where_it_was_taken_to_be():
    _, causal = run(ALONE)
    _, estimates = refined(ALONE)
    for before, after in list(zip(final(causal), estimates, strict=True))[FIRST:BACK]:
        assert before.status is after.status is Status.LOST and UNALIGNED_MAP not in after.diagnostics
        assert np.allclose(after.T_cam_obj, before.T_cam_obj, atol=1e-5)


def test_each_frame_is_looked_at_again_with_the_map_that_answered_it():
    state, _ = refined(ALONE)
    first, second = (map_of_frame(state, index).object_map for index in (2, ALONE - 1))
    assert first.keyframes[0].index < FIRST and second.keyframes[0].index >= BACK
    # Whichever map is at hand, the other is found.
    assert map_of_frame(map_of_frame(state, 2), ALONE - 1).object_map is second
    assert map_of_frame(map_of_frame(state, ALONE - 1), 2).object_map is first


def test_each_map_has_the_agreement_of_its_own_masks():
    state, _ = refined(ALONE)
    here = next(
        index for index in (2, ALONE - 1) if map_of_frame(state, index).object_map is state.object_map
    )
    there = ALONE + 1 - here
    agreement = MaskAgreement(0.8, 0.1, 5)
    state = replace(state, mask_agreement=agreement)
    elsewhere = map_of_frame(state, there)
    assert elsewhere.mask_agreement == MaskAgreement()
    assert map_of_frame(elsewhere, here).mask_agreement == agreement


@pytest.mark.parametrize("count", [BACK + 4, ALONE])
def test_a_run_that_is_stopped_meanwhile_goes_on_as_if_it_had_not_been(count, tmp_path):
    state, _ = run(count)
    assert state.reinitialization or state.inactive_maps
    written = TreeFolder(tmp_path, solver().state_classes).text(state)
    kept = TreeFolder(tmp_path, solver().state_classes).read(json.loads(written))
    frame, mask = shown(count)
    _, expected = solver().step(state, frame, estimate_of(mask))
    _, estimate = solver().step(kept, frame, estimate_of(mask))
    assert np.array_equal(estimate.T_cam_obj, expected.T_cam_obj) and estimate.status is expected.status


def test_a_map_that_stands_aside_goes_through_the_lens_of_the_end():
    state, _ = run(ALONE)
    before = state.camera
    after = before.zoom(1.2, "solved")
    other = refine_inactive_map(state.inactive_maps[0], before, after, solver().options)
    # The first keyframe's pose moves with the lens alone.
    (x, y, z), (u, v, w) = (
        one.object_map.keyframes[0].pose.translation.tolist() for one in (state.inactive_maps[0], other)
    )
    assert (u, v, w) == pytest.approx((x, y, 1.2 * z))
    assert other.unaligned and other.spans == state.inactive_maps[0].spans


def test_the_guess_goes_on_turning_and_keeps_the_size():
    state, _ = run(FIRST)
    similarity = guess_alignment(state, state)
    assert similarity.scale == pytest.approx(1.0)
    # A start from the map itself lies where the motion leads at its keyframes.
    assert np.linalg.det(similarity.R) == pytest.approx(1.0)
    assert np.degrees(np.arccos((np.trace(similarity.R) - 1) / 2)) < 60


def test_of_many_maps_only_the_larger_ones_stand_aside():
    state, _ = run(ALONE)
    small = replace(
        state.inactive_maps[0], object_map=replace(state.inactive_maps[0].object_map, keyframes=())
    )
    large = [replace(state.inactive_maps[0], spans=((n, n),)) for n in range(5)]
    lost, _ = run(FIRST)
    lost = replace(lost, inactive_maps=(large[0], small, *large[1:3]))
    now = switch_map(lost, state, Similarity(np.eye(3), 1.0, np.zeros(3)))
    assert [other.spans[0][0] for other in now.inactive_maps[:3]] == [0, 1, 2] and len(now.inactive_maps) == 4
    assert now.inactive_maps[-1].object_map is lost.object_map and now.unaligned


def test_what_is_lost_is_not_doubted_as_well():
    _, estimates = run(BACK + 1)
    assert mark_unaligned(estimates[-1]) is estimates[-1]
    sure = replace(estimates[5], status=Status.TRACKED, confidence=0.9)
    assert mark_unaligned(sure).status is Status.LOST and mark_unaligned(sure).confidence < 0.1


def test_masks_are_of_one_thing_if_they_overlap():
    left, right, middle = (np.zeros((20, 30), bool) for _ in range(3))
    left[5:15, 2:12], right[5:15, 18:28], middle[5:15, 5:15] = True, True, True
    assert masks_overlap(left, left) and masks_overlap(left, middle)
    assert not masks_overlap(left, right) and not masks_overlap(None, left)


@pytest.mark.parametrize("side", [np.s_[:3, 5:9], np.s_[-3:, 5:9], np.s_[5:9, :3], np.s_[5:9, -3:]])
def test_what_comes_in_over_the_border_is_not_whole(side):
    mask = np.zeros((20, 30), bool)
    assert not is_fully_visible(mask)
    mask[5:9, 5:9] = True
    assert is_fully_visible(mask)
    mask[side] = True
    assert not is_fully_visible(mask)


def test_what_has_the_colours_of_the_surroundings_is_not_the_object():
    state, _ = run(FIRST)
    image, mask = clip().images[40], clip().masks[40]
    assert state.colours is not None and colours_match(state, Frame(BACK, image), mask)
    wall = np.zeros_like(mask)
    wall[2:20, 2:20] = True
    assert not mask[wall].any() and not colours_match(state, Frame(BACK, image), wall)


PLAIN_IMAGE = np.full((180, 240), 120, np.uint8)


@pytest.mark.parametrize(
    ("change", "lost", "doubtful", "needed"),
    [
        ({}, 0, 50, False),
        ({}, 1, 1, True),
        ({"fixed_keyframes": 3}, 1, 1, False),
        ({"pointless": True}, 0, 19, False),
        ({"pointless": True}, 0, 20, True),
        ({"pointless": True}, 1, 1, True),
    ],
)
def test_a_second_map_is_begun_if_the_object_is_lost_or_a_map_without_points_is_doubted_for_long(
    change, lost, doubtful, needed
):
    state, _ = run(FIRST)
    state = replace(
        state, object_map=replace(state.object_map, **change), lost_frames=lost, doubtful_frames=doubtful
    )
    frame, mask = shown(FIRST - 1)
    assert needs_second_map(state, grey(frame.image), mask) is needed


def test_a_map_without_points_is_not_followed_by_another_one():
    state, _ = run(FIRST)
    state = replace(state, object_map=replace(state.object_map, pointless=True), doubtful_frames=99)
    assert not needs_second_map(state, PLAIN_IMAGE, shown(FIRST - 1)[1])


def test_a_map_without_points_gives_way_to_one_with_points():
    """Its frames were doubted all the time: nothing is held to it, and what follows is no guess."""
    state, _ = run(FIRST)
    nothing = replace(state.object_map, pointless=True, keyframes=state.object_map.keyframes[:2])
    state = replace(state, object_map=nothing, lost_frames=3, doubtful_frames=30)
    estimates = []
    for index in range(BACK, BACK + 20):
        frame, mask = shown(index)
        state, estimate = solver().step(state, frame, estimate_of(mask))
        estimates.append(estimate)
        if not state.object_map.pointless:
            break
    assert not state.object_map.pointless
    assert not state.unaligned
    assert state.inactive_maps == ()
    assert estimates[-1].status is Status.TRACKED
    assert all(one.status is not Status.LOST for one in estimates[-1].revised)
