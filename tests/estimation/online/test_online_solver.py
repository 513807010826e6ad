"""The online solver waits, starts, tracks, loses, finds again, and looks at everything once more."""

from __future__ import annotations

import numpy as np
import pytest
from online_runs import (
    FRAMES,
    empty_frame,
    estimate_of,
    final,
    frame,
    known_run,
    refined_run,
    revisited,
    rotation_errors,
    run,
    solver,
    true_mask,
    turning_clip,
    whole_run,
    with_true_masks,
)

from tracking3d.config.loading import load_config
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import MOTION_RATIO, MOVES, Status
from tracking3d.estimation.online.state.solver_state import Initializing
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline.track import track
from tracking3d_bench.evaluation.metrics import mask_iou


def overlaps(estimates):
    return np.array([mask_iou(estimate.mask, true_mask(estimate.index)) for estimate in estimates])


def same(a, b) -> bool:
    """Whether two answers say the same; the time spent is no answer."""
    return bool(
        (a.T_cam_obj == b.T_cam_obj).all()
        and (a.mask == b.mask).all()
        and (a.status, a.reason, a.confidence, a.losses, a.hypothesis, a.keyframe)
        == (b.status, b.reason, b.confidence, b.losses, b.hypothesis, b.keyframe)
    )


def started() -> int:
    """The frame at which the whole run starts."""
    return next(estimate.index for estimate in whole_run()[1] if estimate.revised)


def test_it_is_a_solver_that_refines():
    assert isinstance(solver(), RefiningSolver)


def test_the_first_answers_are_the_initial_masks_uncertain_and_say_why():
    early = whole_run()[1][: started()]
    assert early
    for estimate in early:
        assert estimate.status is Status.UNCERTAIN
        assert "do not tell the shape" in estimate.reason
        assert 0 < estimate.confidence < 0.5
        np.testing.assert_array_equal(estimate.mask, true_mask(estimate.index))
        np.testing.assert_array_equal(estimate.initial_mask, true_mask(estimate.index))


def test_all_waiting_frames_are_answered_anew_once_and_at_once():
    estimates = whole_run()[1]
    start = estimates[started()]
    assert [better.index for better in start.revised] == list(range(start.index))
    assert all(better.status is Status.TRACKED for better in start.revised)
    assert all(better.hypothesis and not better.refined for better in start.revised)
    assert sum(bool(estimate.revised) for estimate in estimates) == 1
    assert start.index <= 6  # 30 degrees


def test_rotations_are_found_and_the_silhouette_overlaps_the_object():
    estimates = final(whole_run()[1])
    assert [estimate.index for estimate in estimates] == list(range(FRAMES))
    assert all(estimate.status is Status.TRACKED and not estimate.reason for estimate in estimates)
    errors = rotation_errors(estimates)
    assert errors.mean() < 2.5
    assert errors.max() < 5
    assert overlaps(estimates).min() > 0.9
    object_map = whole_run()[0].object_map
    for estimate in estimates:
        assert not estimate.refined
        assert estimate.diagnostics["mask_iou"] > 0.85
        assert np.linalg.det(estimate.T_cam_obj[:3, :3]) == pytest.approx(1, abs=1e-5)
    last = whole_run()[0].last_pose[0]
    assert mask_iou(object_map.silhouette(last, turning_clip().camera), true_mask(FRAMES - 1)) > 0.9


def test_it_turns_as_far_as_the_object_does():
    first, last = (final(whole_run()[1])[n].T_cam_obj[:3, :3] for n in (0, -1))
    turned = np.degrees(np.arccos((np.trace(last @ first.T) - 1) / 2))
    assert turned == pytest.approx(5 * (FRAMES - 1), abs=6)


def test_a_second_look_is_refined_and_as_good():
    causal = final(whole_run()[1])
    _, refined = refined_run()
    assert all(estimate.refined and estimate.status is Status.TRACKED for estimate in refined)
    errors = rotation_errors(refined)
    assert errors.max() < 3
    assert errors.mean() < rotation_errors(causal).mean() + 0.1
    assert overlaps(refined).mean() > 0.95


def test_the_object_is_textured_where_it_was_seen():
    model = solver().result(whole_run()[0])
    assert np.isfinite(model.vertices).all()
    assert model.texture.shape == (150, 150, 3)
    assert 0.2 < (model.texture_weight > 0).mean() < 1
    assert model.texture[model.texture_weight > 0].std() > 5


def test_a_step_does_not_change_the_state_it_starts_from():
    state, _ = whole_run()
    landmarks, vertices = state.object_map.landmarks.copy(), state.object_map.vertices.clone()
    shown, given = frame(FRAMES, FRAMES - 4), estimate_of(true_mask(FRAMES - 4))
    solver().step(state, empty_frame(FRAMES), estimate_of(None))
    (once_more, once), (_, again) = (solver().step(state, shown, given) for _ in range(2))
    assert same(once, again)
    assert once_more.last_pose[1] == FRAMES
    assert state.last_pose[1] == FRAMES - 1
    np.testing.assert_array_equal(state.object_map.landmarks, landmarks)
    assert bool((state.object_map.vertices == vertices).all())


@pytest.mark.slow
@pytest.mark.usefixtures("made_anew")
def test_the_same_video_gives_the_same_start():
    estimates = whole_run()[1]
    _, again = run(with_true_masks(range(started() + 1)))
    assert same(again[-1], estimates[started()])
    assert all(same(a, b) for a, b in zip(again[-1].revised, estimates[started()].revised, strict=True))


def test_a_revisit_does_not_change_the_state_either():
    state, _ = refined_run()
    given, causal = estimate_of(true_mask(3)), final(whole_run()[1])[3].T_cam_obj
    one, other = (solver().refine_frame(state, frame(3), given, causal)[1] for _ in range(2))
    assert same(one, other)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "missing"),
    [(1, None), (8, np.zeros((120, 160), bool))],
    ids=["none while it waits", "an empty one later"],
)
def test_one_frame_without_a_mask_is_survived(at, missing):
    given = [(frame(at), missing), *with_true_masks(range(at + 1, 10))]
    estimates = final(run(given, after=known_run(at))[1])
    assert estimates[at].initial_mask is None
    assert estimates[at].status is Status.TRACKED
    assert overlaps(estimates[at:]).min() > 0.85
    assert rotation_errors(estimates).max() < 8


def test_what_has_vanished_is_lost_and_found_again():
    state, _ = whole_run()
    for index in range(FRAMES, FRAMES + 3):
        state, estimate = solver().step(state, empty_frame(index), estimate_of(None))
        assert estimate.status is Status.LOST
        assert "out of sight" in estimate.reason
        assert estimate.confidence < 0.1
        assert not estimate.mask.any()
        assert np.isfinite(estimate.T_cam_obj).all()
    # It comes back as it was three frames before it went.
    shown = FRAMES - 3
    state, back = solver().step(state, frame(FRAMES + 3, shown), estimate_of(true_mask(shown)))
    assert back.status is Status.TRACKED
    assert mask_iou(back.mask, true_mask(shown)) > 0.9
    before = whole_run()[1][shown].T_cam_obj[:3, :3]
    turned = np.degrees(np.arccos(np.clip((np.trace(back.T_cam_obj[:3, :3] @ before.T) - 1) / 2, -1, 1)))
    assert turned < 6


def test_a_side_that_the_masks_leave_out_is_taken_in_since_it_moves_along():
    last = FRAMES - 1
    leftmost = [np.flatnonzero(true_mask(index).any(0))[0] for index in range(FRAMES)]
    cut = {index: true_mask(index) & (np.arange(160) >= leftmost[index] + 8) for index in range(9, FRAMES)}
    _, estimates = run([(frame(index), cut[index]) for index in cut], after=known_run(9))
    estimate = estimates[-1]
    assert mask_iou(estimate.mask, true_mask(last)) > mask_iou(cut[last], true_mask(last)) + 0.03
    assert max(one.diagnostics[MOTION_RATIO] for one in estimates[9:]) > MOVES
    assert all(
        one.diagnostics[MOTION_RATIO] < MOVES for one in whole_run()[1][started() + 1 :]
    )  # true masks lack nothing


def test_an_object_that_is_still_stays_uncertain_and_says_why():
    random, image = np.random.default_rng(0), turning_clip().images[0].astype(float)

    def still(index: int) -> Frame:
        noisy = image + 2 * random.standard_normal(image.shape)
        return Frame(index, np.clip(noisy.round(), 0, 255).astype(np.uint8))

    state, estimates = run((still(index), true_mask(0)) for index in range(45))
    assert all(estimate.status is Status.UNCERTAIN and not estimate.revised for estimate in estimates)
    assert "do not tell the shape" in estimates[20].reason
    assert "has not moved yet" in estimates[-1].reason
    assert all((estimate.mask == true_mask(0)).all() for estimate in estimates)
    # What waits is bounded.
    assert isinstance(state, Initializing)
    assert len(state.pending) <= 41


def test_the_last_word_on_a_video_that_ends_without_a_map_is_what_was_found():
    few = [(Frame(index, turning_clip().images[index]), true_mask(index)) for index in range(3)]
    state, estimates = run(iter(few))
    state = solver().refine(state)
    _, last = solver().refine_frame(state, few[0][0], MaskEstimate(few[0][1]), estimates[0].T_cam_obj)
    assert last.reason == "a first map takes 4 frames that show the object, and there are 3"


def test_three_frames_are_too_few_and_still_answered():
    state, estimates = run(with_true_masks(range(3)))
    assert all(estimate.status is Status.UNCERTAIN for estimate in estimates)
    model = solver().result(state)
    assert np.isfinite(model.vertices).all()
    assert (model.texture_weight > 0).any()
    _, refined = revisited(state, estimates)
    for estimate, causal in zip(refined, estimates, strict=True):
        assert estimate.refined
        assert estimate.status is Status.UNCERTAIN
        assert estimate.reason
        np.testing.assert_array_equal(estimate.mask, causal.mask)
        np.testing.assert_allclose(estimate.T_cam_obj, causal.T_cam_obj, atol=1e-5)


@pytest.mark.parametrize("mask", [None, np.zeros((120, 160), np.float32)], ids=["none", "empty"])
def test_a_first_frame_without_an_object_is_refused_by_name(mask):
    with pytest.raises(InputError, match=r"frame 0 has no object.*another box or mask"):
        solver().init(frame(0), MaskEstimate(mask))


def test_a_single_pixel_as_first_mask_is_no_traceback():
    speck = np.zeros((120, 160), bool)
    speck[60, 80] = True
    _, estimates = run([(frame(0), speck), (frame(1), true_mask(1))])
    assert [estimate.status for estimate in estimates] == [Status.UNCERTAIN] * 2


def test_a_video_without_anything_to_follow_is_answered_with_its_masks():
    mask = np.zeros((60, 80), bool)
    mask[15:45, 20:50] = True
    images = np.zeros((8, 60, 80, 3), np.uint8)
    estimates = list(
        track(images, mask=mask, config=load_config(overrides=["solver.tracker_feedback=false"]))
    )
    assert {estimate.status for estimate in estimates} == {Status.UNCERTAIN}
    np.testing.assert_array_equal(estimates[0].mask, mask)
