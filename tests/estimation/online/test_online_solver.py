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
from tracking3d.estimation.correction import MOVES, MOVING
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.evaluation.metrics import mask_iou
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline import track


def overlaps(answers):
    return np.array([mask_iou(answer.mask, true_mask(answer.index)) for answer in answers])


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
    return next(answer.index for answer in whole_run()[1] if answer.revised)


def test_it_is_a_solver_that_refines():
    assert isinstance(solver(), RefiningSolver)


def test_the_first_answers_are_the_initial_masks_uncertain_and_say_why():
    early = whole_run()[1][: started()]
    assert early
    for answer in early:
        assert answer.status is Status.UNCERTAIN
        assert "not moved enough" in answer.reason
        assert 0 < answer.confidence < 0.5
        np.testing.assert_array_equal(answer.mask, true_mask(answer.index))
        np.testing.assert_array_equal(answer.initial_mask, true_mask(answer.index))


def test_all_waiting_frames_are_answered_anew_once_and_at_once():
    answers = whole_run()[1]
    start = answers[started()]
    assert [better.index for better in start.revised] == list(range(start.index))
    assert all(better.status is Status.TRACKED for better in start.revised)
    assert all(better.hypothesis and not better.refined for better in start.revised)
    assert sum(bool(answer.revised) for answer in answers) == 1
    assert start.index <= 6  # 30 degrees


def test_rotations_are_found_and_the_silhouette_overlaps_the_object():
    answers = final(whole_run()[1])
    assert [answer.index for answer in answers] == list(range(FRAMES))
    assert all(answer.status is Status.TRACKED and not answer.reason for answer in answers)
    errors = rotation_errors(answers)
    assert errors.mean() < 2.5
    assert errors.max() < 5
    assert overlaps(answers).min() > 0.9
    known = whole_run()[0].known
    for answer in answers:
        assert not answer.refined
        assert answer.losses["overlap"] > 0.85
        assert np.linalg.det(answer.T_cam_obj[:3, :3]) == pytest.approx(1, abs=1e-5)
    last = whole_run()[0].last[0]
    assert mask_iou(known.silhouette(last, turning_clip().camera), true_mask(FRAMES - 1)) > 0.9


def test_it_turns_as_far_as_the_object_does():
    first, last = (final(whole_run()[1])[n].T_cam_obj[:3, :3] for n in (0, -1))
    turned = np.degrees(np.arccos((np.trace(last @ first.T) - 1) / 2))
    assert turned == pytest.approx(5 * (FRAMES - 1), abs=6)


def test_a_second_look_is_refined_and_better():
    causal = final(whole_run()[1])
    _, refined = refined_run()
    assert all(answer.refined and answer.status is Status.TRACKED for answer in refined)
    errors = rotation_errors(refined)
    assert errors.max() < 3
    assert errors.mean() < rotation_errors(causal).mean()
    assert overlaps(refined).mean() > 0.95


def test_the_object_is_textured_where_it_was_seen():
    model = solver().result(whole_run()[0])
    assert np.isfinite(model.vertices).all()
    assert model.texture.shape == (150, 150, 3)
    assert 0.2 < (model.texture_weight > 0).mean() < 1
    assert model.texture[model.texture_weight > 0].std() > 5


def test_a_step_does_not_change_the_state_it_starts_from():
    state, _ = whole_run()
    landmarks, vertices = state.known.landmarks.copy(), state.known.vertices.clone()
    shown, given = frame(FRAMES, FRAMES - 4), estimate_of(true_mask(FRAMES - 4))
    solver().step(state, empty_frame(FRAMES), estimate_of(None))
    (once_more, once), (_, again) = (solver().step(state, shown, given) for _ in range(2))
    assert same(once, again)
    assert once_more.last[1] == FRAMES
    assert state.last[1] == FRAMES - 1
    np.testing.assert_array_equal(state.known.landmarks, landmarks)
    assert bool((state.known.vertices == vertices).all())


@pytest.mark.slow
@pytest.mark.usefixtures("made_anew")
def test_the_same_video_gives_the_same_start():
    answers = whole_run()[1]
    _, again = run(with_true_masks(range(started() + 1)))
    assert same(again[-1], answers[started()])
    assert all(same(a, b) for a, b in zip(again[-1].revised, answers[started()].revised, strict=True))


def test_a_revisit_does_not_change_the_state_either():
    state, _ = refined_run()
    given, causal = estimate_of(true_mask(3)), final(whole_run()[1])[3].T_cam_obj
    one, other = (solver().revisit(state, frame(3), given, causal)[1] for _ in range(2))
    assert same(one, other)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "missing"),
    [(1, None), (8, np.zeros((120, 160), bool))],
    ids=["none while it waits", "an empty one later"],
)
def test_one_frame_without_a_mask_is_survived(at, missing):
    given = [(frame(at), missing), *with_true_masks(range(at + 1, 10))]
    answers = final(run(given, after=known_run(at))[1])
    assert answers[at].initial_mask is None
    assert answers[at].status is Status.TRACKED
    assert overlaps(answers[at:]).min() > 0.85
    assert rotation_errors(answers).max() < 8


def test_what_has_vanished_is_lost_and_found_again():
    state, _ = whole_run()
    for index in range(FRAMES, FRAMES + 3):
        state, answer = solver().step(state, empty_frame(index), estimate_of(None))
        assert answer.status is Status.LOST
        assert "out of sight" in answer.reason
        assert answer.confidence < 0.1
        assert not answer.mask.any()
        assert np.isfinite(answer.T_cam_obj).all()
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
    _, answers = run([(frame(index), cut[index]) for index in cut], after=known_run(9))
    answer = answers[-1]
    assert mask_iou(answer.mask, true_mask(last)) > mask_iou(cut[last], true_mask(last)) + 0.03
    assert max(one.losses[MOVING] for one in answers[9:]) > MOVES
    assert all(
        one.losses[MOVING] < MOVES for one in whole_run()[1][started() + 1 :]
    )  # true masks lack nothing


def test_an_object_that_is_still_stays_uncertain_and_says_why():
    random, image = np.random.default_rng(0), turning_clip().images[0].astype(float)

    def still(index: int) -> Frame:
        noisy = image + 2 * random.standard_normal(image.shape)
        return Frame(index, np.clip(noisy.round(), 0, 255).astype(np.uint8))

    state, answers = run((still(index), true_mask(0)) for index in range(45))
    assert all(answer.status is Status.UNCERTAIN and not answer.revised for answer in answers)
    assert "not moved enough" in answers[20].reason
    assert "still" in answers[-1].reason
    assert all((answer.mask == true_mask(0)).all() for answer in answers)
    # What waits is bounded.
    assert state.waiting is not None
    assert len(state.waiting) <= 41


def test_three_frames_are_too_few_and_still_answered():
    state, answers = run(with_true_masks(range(3)))
    assert all(answer.status is Status.UNCERTAIN for answer in answers)
    model = solver().result(state)
    assert np.isfinite(model.vertices).all()
    assert (model.texture_weight > 0).any()
    _, refined = revisited(state, answers)
    for answer, causal in zip(refined, answers, strict=True):
        assert answer.refined
        assert answer.status is Status.UNCERTAIN
        assert answer.reason
        np.testing.assert_array_equal(answer.mask, causal.mask)
        np.testing.assert_allclose(answer.T_cam_obj, causal.T_cam_obj, atol=1e-5)


@pytest.mark.parametrize("mask", [None, np.zeros((120, 160), np.float32)], ids=["none", "empty"])
def test_a_first_frame_without_an_object_is_refused_by_name(mask):
    with pytest.raises(InputError, match=r"frame 0 has no object.*another box or mask"):
        solver().init(frame(0), MaskEstimate(mask))


def test_a_single_pixel_as_first_mask_is_no_traceback():
    speck = np.zeros((120, 160), bool)
    speck[60, 80] = True
    _, answers = run([(frame(0), speck), (frame(1), true_mask(1))])
    assert [answer.status for answer in answers] == [Status.UNCERTAIN] * 2


def test_a_video_without_anything_to_follow_is_answered_with_its_masks():
    mask = np.zeros((60, 80), bool)
    mask[15:45, 20:50] = True
    images = np.zeros((16, 60, 80, 3), np.uint8)
    answers = list(track(images, mask=mask, config=load_config(overrides=["solver.correct_tracker=false"])))
    assert {answer.status for answer in answers} == {Status.UNCERTAIN}
    np.testing.assert_array_equal(answers[0].mask, mask)
