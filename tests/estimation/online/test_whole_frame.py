"""A lost object is found again by its points wherever it is seen, and nothing else is taken for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from online_runs import FRAMES, empty_frame, estimate_of, frame, solver, true_mask, whole_run

from tracking3d.estimation.estimate import RELOCALIZED, Assessment, MaskSource, Status, corrects
from tracking3d.estimation.online import relocalization, tracker
from tracking3d.estimation.online.features.klt import grey
from tracking3d.estimation.online.relocalization import overlaps_mask, relocalize_in_frame
from tracking3d.frames import Frame
from tracking3d_bench.evaluation.metrics import mask_iou

SHOWN = FRAMES - 3
"""The frame whose picture of the object comes back."""


def moved(array: np.ndarray, aside: int) -> np.ndarray:
    """Shifted to the right; what comes in at the left is what was at the left edge."""
    return np.concatenate([np.repeat(array[:, :1], aside, axis=1), array[:, :-aside]], axis=1)


def wrong_mask() -> np.ndarray:
    """What a tracker clings to: a corner of the wall."""
    mask = np.zeros_like(true_mask(0))
    mask[2:14, 2:14] = True
    return mask


def lost_for(frames: int):
    """The state after so many frames without the object, in which the tracker clings to the wall."""
    state, _ = whole_run()
    for index in range(FRAMES, FRAMES + frames):
        state, estimate = solver().step(state, empty_frame(index), estimate_of(wrong_mask()))
        assert estimate.status is Status.LOST
    return state


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1, 7])
def test_what_comes_back_elsewhere_is_found_while_the_mask_clings_to_the_wall(frames):
    aside = 12
    index = FRAMES + frames
    image, mask = moved(frame(SHOWN).image, aside), moved(true_mask(SHOWN), aside)
    state, back = solver().step(lost_for(frames), Frame(index, image), estimate_of(wrong_mask()))
    assert (back.status, back.hypothesis) == (Status.TRACKED, RELOCALIZED)
    assert back.mask_source is MaskSource.RENDERED
    assert mask_iou(back.mask, mask) > 0.85
    assert (back.initial_mask == wrong_mask()).all()
    assert corrects(back)
    # The map learns nothing from a frame without a mask of its own, and the next one goes on as usual.
    assert not back.keyframe and state.lost_frames == 0
    _, after = solver().step(state, Frame(index + 1, image), estimate_of(mask))
    assert after.status is Status.TRACKED and mask_iou(after.mask, mask) > 0.9


@pytest.mark.parametrize(("most", "searched"), [(0, False), (10**6, True)])
def test_a_doubtful_pose_with_more_points_than_a_search_finds_is_not_searched_for(
    monkeypatch, most, searched
):
    state, _ = whole_run()
    last, index = state.last_pose
    view = replace(state.object_map.keyframes[-1], pose=last)
    asked = []
    monkeypatch.setattr(tracker, "_MOST_ELSEWHERE", most)
    monkeypatch.setattr(tracker, "assess_pose", lambda *_, **__: Assessment(Status.UNCERTAIN, "", 0.1))
    monkeypatch.setattr(tracker.Tracker, "_elsewhere", lambda *_: asked.append(1))
    shown = frame(view.index)
    solver().tracker.find(state, view, replace(shown, index=index + 1), grey(shown.image))
    assert bool(asked) == searched


def test_where_it_is_not_nothing_is_found():
    state, _ = whole_run()
    pose = state.trajectory[-1][0]
    assert relocalize_in_frame(state.object_map, state.camera, grey(empty_frame(0).image), pose) is None
    noise = np.random.default_rng(0).integers(0, 256, true_mask(0).shape, np.uint8)
    assert relocalize_in_frame(state.object_map, state.camera, noise, pose) is None
    flat = np.full(true_mask(0).shape, 128, np.uint8)
    assert relocalize_in_frame(state.object_map, state.camera, flat, pose) is None


def test_a_map_without_keyframes_sees_nothing():
    state, _ = whole_run()
    nothing = replace(state.object_map, keyframes=())
    assert relocalize_in_frame(nothing, state.camera, grey(frame(0).image), state.trajectory[-1][0]) is None


def test_a_mask_is_elsewhere_if_hardly_any_of_it_is_at_the_silhouette():
    silhouette, half, far = (np.zeros((40, 60), bool) for _ in range(3))
    silhouette[10:30, 10:30] = True
    half[10:30, 20:40] = True  # a third of both together
    far[10:30, 28:48] = True
    assert overlaps_mask(silhouette, silhouette) and overlaps_mask(silhouette, half)
    assert not overlaps_mask(silhouette, far)
    assert not overlaps_mask(silhouette, np.zeros((40, 60), bool))


def test_no_keypoints_are_looked_for_if_the_map_has_none(monkeypatch):
    monkeypatch.setattr(relocalization, "detect_turned", lambda *_, **__: pytest.fail("for nothing"))
    state, _ = whole_run()
    plain, image, view = (
        replace(state.object_map, pointless=True),
        grey(frame(0).image),
        state.object_map.keyframes[0],
    )
    assert relocalize_in_frame(plain, state.camera, image, view.pose) is None
    assert relocalization.match_keyframes(plain, state.camera, view, image, anywhere=True) == []


def test_a_frame_with_a_mask_that_was_moved_becomes_no_keyframe(monkeypatch):
    monkeypatch.setattr("tracking3d.estimation.online.solver.needs_keyframe", lambda *_: True)
    state, _ = whole_run()
    own = replace(estimate_of(true_mask(FRAMES - 1)), carried=True)
    again = Frame(FRAMES, frame(FRAMES - 1).image)
    assert not solver().step(state, again, own)[1].keyframe
    assert solver().step(state, again, replace(own, carried=False))[1].keyframe


@pytest.mark.parametrize("contradicted", [False, True])
def test_a_pose_whose_points_agree_is_fitted_to_pixels_coarsely_unless_they_contradict_it(
    monkeypatch, contradicted
):
    state, _ = whole_run()
    shown = frame(FRAMES, shown=FRAMES - 1)
    steps = []
    fit_pose = tracker.fit_pose
    monkeypatch.setattr(
        tracker,
        "fit_pose",
        lambda *given: steps.append(sum((4, 5) if len(given) < 7 else given[6])) or fit_pose(*given),
    )
    if contradicted:
        monkeypatch.setattr(tracker, "_MOST_ELSEWHERE", 10**6)
        monkeypatch.setattr(tracker, "needs_relocalization", lambda *_: True)
        monkeypatch.setattr(tracker, "relocalize", lambda state, view, image, best, *_: best)
    _, estimate = solver().step(state, shown, estimate_of(true_mask(FRAMES - 1)))
    assert steps == ([4, 9] if contradicted else [4])
    assert estimate.status is Status.TRACKED and mask_iou(estimate.mask, true_mask(FRAMES - 1)) > 0.9
