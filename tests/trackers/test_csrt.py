"""The csrt tracker: masks of known truth, determinism, causality, correction and hostile input."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from moving_shape import SIZE, box_around, iou, moving_shape
from pydantic import ValidationError

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.box_trackers import BoxOffset
from tracking3d.trackers.csrt import CsrtTracker
from tracking3d.trackers.protocol import CorrectableTracker, ForewarnedTracker, MaskTracker, Options
from tracking3d.trackers.segmentation import ColourSegmentation


def tracker(**options: object) -> CsrtTracker:
    """With a crop of 96 pixels a side where users have 224, unless that is said."""
    return CsrtTracker.from_options(CsrtTracker.Options(**{"segmentation_size": 96} | options))


def track(frames: list[Frame], prompt: Prompt, **options: object) -> list[MaskEstimate]:
    csrt = tracker(**options)
    return [csrt.init(frames[0], prompt), *(csrt.step(frame) for frame in frames[1:])]


def assert_valid(estimate: MaskEstimate, size: tuple[int, int]) -> None:
    assert 0 <= estimate.score <= 1
    if estimate.mask is None:
        assert estimate.reason
    else:
        assert estimate.mask.shape == size and estimate.mask.dtype == np.float32
        assert estimate.mask.min() >= 0 and estimate.mask.max() <= 1
        assert estimate.binary.any()


def test_it_is_a_correctable_mask_tracker() -> None:
    assert isinstance(tracker(), MaskTracker)
    assert isinstance(tracker(), CorrectableTracker)


@pytest.mark.parametrize("with_mask", [False, True])
def test_a_moving_shape_is_followed(with_mask: bool) -> None:
    frames, truth = moving_shape(16)
    estimates = track(frames, Prompt(box_around(truth[0]), truth[0] if with_mask else None))
    ious = [iou(estimate.binary, mask) for estimate, mask in zip(estimates, truth, strict=True)]
    assert min(ious) > 0.9, ious
    assert min(estimate.score for estimate in estimates) > 0.5


def test_a_given_mask_is_the_first_answer() -> None:
    frames, truth = moving_shape(1)
    (estimate,) = track(frames, Prompt(box_around(truth[0]), truth[0]))
    np.testing.assert_array_equal(estimate.binary, truth[0])


@pytest.mark.usefixtures("made_anew")
def test_the_same_video_gives_the_same_masks_whatever_the_random_state() -> None:
    frames, truth = moving_shape(5)
    prompt = Prompt(box_around(truth[0]))
    cv2.setRNGSeed(1)
    once = track(frames, prompt)
    cv2.setRNGSeed(2)
    again = track(frames, prompt)
    for a, b in zip(once, again, strict=True):
        np.testing.assert_array_equal(a.mask, b.mask)
        assert a.score == b.score


@pytest.mark.parametrize("turns_up", [True, False])
def test_frames_that_are_announced_change_no_answer(turns_up: bool) -> None:
    frames, truth = moving_shape(6)
    prompt = Prompt(box_around(truth[0]))
    csrt, forewarned = tracker(), tracker()
    assert isinstance(forewarned, ForewarnedTracker)
    for one in (csrt, forewarned):
        one.init(frames[0], prompt)
    for frame in frames[1:]:
        forewarned.announce(frame if turns_up else Frame(frame.index, frame.image.copy()))
        a, b = csrt.step(frame), forewarned.step(frame)
        if turns_up:
            np.testing.assert_array_equal(a.mask, b.mask)
            assert a.score == b.score
        else:  # it has seen the frame twice, and goes on
            assert_valid(b, SIZE)


def test_a_correction_forgets_the_box_that_was_looked_for_beside() -> None:
    frames, truth = moving_shape(6)
    elsewhere = np.roll(truth[1], 40, axis=1)
    answers = []
    for announces in (False, True):
        csrt = tracker()
        csrt.init(frames[0], Prompt(box_around(truth[0])))
        csrt.step(frames[1])
        if announces:
            csrt.announce(frames[2])
        csrt.correct(frames[1], elsewhere)
        answers.append(csrt.step(frames[2]))
    np.testing.assert_array_equal(answers[0].mask, answers[1].mask)
    assert answers[0].score == answers[1].score


def test_answers_do_not_depend_on_later_frames() -> None:
    frames, truth = moving_shape(6)
    prompt = Prompt(box_around(truth[0]))
    black = [Frame(index, np.zeros((*SIZE, 3), np.uint8)) for index in (4, 5)]
    for a, b in zip(track(frames, prompt)[:4], track(frames[:4] + black, prompt)[:4], strict=True):
        np.testing.assert_array_equal(a.mask, b.mask)


def test_frames_and_answers_are_left_alone() -> None:
    frames, truth = moving_shape(3)
    images = [frame.image.copy() for frame in frames]
    csrt = tracker()
    first = csrt.init(frames[0], Prompt(box_around(truth[0]), truth[0]))
    kept = first.mask.copy()
    csrt.step(frames[1])
    csrt.correct(frames[1], truth[1])
    csrt.step(frames[2])
    np.testing.assert_array_equal(first.mask, kept)
    for frame, image in zip(frames, images, strict=True):
        np.testing.assert_array_equal(frame.image, image)


def test_a_correction_brings_a_wrong_start_back() -> None:
    frames, truth = moving_shape(8)
    csrt = tracker()
    csrt.init(frames[0], Prompt((180.0, 20.0, 30.0, 30.0)))
    wrong = csrt.step(frames[1])
    assert wrong.mask is None or iou(wrong.binary, truth[1]) < 0.2
    csrt.correct(frames[1], truth[1])
    after = [csrt.step(frame) for frame in frames[2:]]
    assert min(iou(e.binary, m) for e, m in zip(after, truth[2:], strict=True)) > 0.85


def test_a_correction_keeps_a_filter_that_is_on_the_object_and_renews_one_that_has_strayed() -> None:
    frames, truth = moving_shape(4)
    csrt = tracker()
    csrt.init(frames[0], Prompt(box_around(truth[0])))
    learnt = csrt._boxes
    csrt.step(frames[1])
    csrt.correct(frames[1], truth[1])
    assert csrt._boxes is learnt
    csrt.step(frames[2])
    csrt.correct(frames[2], np.roll(truth[2], 20, axis=1))
    assert csrt._boxes is not learnt


def test_corrections_by_the_truth_in_every_frame_help_a_start_that_took_too_much() -> None:
    frames, truth = moving_shape(10)
    x, y, width, height = box_around(truth[0])
    too_much = np.zeros(SIZE, bool)
    too_much[int(y) - 12 : int(y + height) + 12, int(x) - 12 : int(x + width) + 12] = True
    means = []
    for corrected in (False, True):
        csrt = tracker()
        csrt.init(frames[0], Prompt((x, y, width, height), too_much))
        overlaps = []
        for frame, mask in zip(frames[1:], truth[1:], strict=True):
            overlaps.append(iou(csrt.step(frame).binary, mask))
            if corrected:
                csrt.correct(frame, mask)
        means.append(np.mean(overlaps[1:]))
    assert means[1] > 0.9
    assert means[1] > means[0] + 0.05


def test_a_correction_in_place_keeps_the_motion_and_one_elsewhere_forgets_it() -> None:
    frames, truth = moving_shape(4, step=10)
    segmentation = ColourSegmentation(frames[0].image, box_around(truth[0]), truth[0])
    for frame in frames[1:3]:
        segmentation.step(frame.image)
    assert segmentation._velocity[0] == pytest.approx(10, abs=2)
    kept = segmentation._velocity
    segmentation.correct(frames[2].image, truth[2])
    assert segmentation._velocity == kept
    segmentation.correct(frames[2].image, np.roll(truth[2], 110, axis=1))
    assert segmentation._velocity == (0, 0)


def test_an_empty_correction_changes_nothing() -> None:
    frames, truth = moving_shape(3)
    csrt = tracker()
    csrt.init(frames[0], Prompt(box_around(truth[0])))
    csrt.step(frames[1])
    csrt.correct(frames[1], np.zeros(SIZE, bool))
    assert iou(csrt.step(frames[2]).binary, truth[2]) > 0.9


def test_an_object_that_leaves_the_frame_has_no_mask() -> None:
    frames, truth = moving_shape(24, step=12.0, turn=0.0)
    assert not truth[-1].any()
    estimates = track(frames, Prompt(box_around(truth[0])))
    for estimate in estimates:
        assert_valid(estimate, SIZE)
    assert estimates[-1].mask is None and estimates[-1].reason


def test_a_box_partly_outside_the_frame_is_clipped() -> None:
    frames, truth = moving_shape(6, start=10.0)
    x, y, width, height = box_around(truth[0])
    estimates = track(frames, Prompt((x - 40, y, width + 40, height)))
    assert min(iou(e.binary, m) for e, m in zip(estimates, truth, strict=True)) > 0.8


@pytest.mark.parametrize("box", [(300.0, 10.0, 20.0, 20.0), (-50.0, -50.0, 40.0, 40.0)])
def test_a_box_outside_the_frame_is_an_input_error(box: tuple[float, float, float, float]) -> None:
    frames, _ = moving_shape(1)
    with pytest.raises(InputError, match="outside frame 0"):
        tracker().init(frames[0], Prompt(box))


@pytest.mark.parametrize(
    "box",
    [(100.0, 80.0, 1.0, 1.0), (0.0, 0.0, 2.5, 60.0), (239.0, 179.0, 1.0, 1.0), (0.0, 0.0, 240.0, 180.0)],
)
@pytest.mark.parametrize("picture", ["shape", "black", "white", "noise"])
def test_any_box_in_any_image_is_answered(box: tuple[float, float, float, float], picture: str) -> None:
    images = {
        "shape": [frame.image for frame in moving_shape(3)[0]],
        "black": [np.zeros((*SIZE, 3), np.uint8)] * 3,
        "white": [np.full((*SIZE, 3), 255, np.uint8)] * 3,
        "noise": list(np.random.default_rng(0).integers(0, 256, (3, *SIZE, 3), np.uint8)),
    }[picture]
    for estimate in track([Frame(index, image) for index, image in enumerate(images)], Prompt(box)):
        assert_valid(estimate, SIZE)


@pytest.mark.parametrize("size", [(8, 8), (5, 300), (33, 1)])
def test_tiny_frames_are_answered(size: tuple[int, int]) -> None:
    images = np.random.default_rng(0).integers(0, 256, (3, *size, 3), np.uint8)
    frames = [Frame(index, image) for index, image in enumerate(images)]
    for estimate in track(frames, Prompt((0.0, 0.0, float(size[1]), float(size[0])))):
        assert_valid(estimate, size)


def test_a_cut_to_black_is_answered_with_a_low_score() -> None:
    frames, truth = moving_shape(4)
    black = Frame(4, np.zeros((*SIZE, 3), np.uint8))
    estimates = track([*frames, black, black], Prompt(box_around(truth[0])))
    assert estimates[-1].score < 0.4 < estimates[3].score


def test_the_segmentation_works_without_a_witness() -> None:
    frames, truth = moving_shape(8)
    segmentation = ColourSegmentation(frames[0].image, box_around(truth[0]))
    for frame, mask in zip(frames[1:], truth[1:], strict=True):
        assert iou(segmentation.step(frame.image).binary, mask) > 0.9


def test_options_are_checked() -> None:
    with pytest.raises(ValidationError):
        CsrtTracker.Options(padding=-1)
    with pytest.raises(ValidationError):
        CsrtTracker.Options(paddding=3)
    with pytest.raises(PluginError):
        CsrtTracker.from_options(Options())
    assert all(field.description for field in CsrtTracker.Options.model_fields.values())


def test_options_reach_the_filter() -> None:
    frames, truth = moving_shape(6)
    prompt = Prompt(box_around(truth[0]))
    for options in (
        {"resolution": 0.5},
        {"template_size": 64.0, "use_hog": False},
        {"segmentation_size": 224},
    ):
        csrt = tracker(**options)
        csrt.init(frames[0], prompt)
        estimates = [csrt.step(frame) for frame in frames[1:]]
        assert iou(estimates[-1].binary, truth[-1]) > 0.85, options


def test_a_frame_before_the_start_is_a_plugin_error() -> None:
    with pytest.raises(PluginError):
        tracker().step(moving_shape(1)[0][0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clip", "expected"),
    [("car_shadow", 0.75), ("temple_ring", 0.80), ("box_in_hand", 0.85), ("cube_in_hand", 0.60)],
)
def test_real_clips_from_a_box(shared_data: Path, clip: str, expected: float) -> None:
    folder = shared_data / clip
    paths = sorted((folder / "frames").glob("*.jpg"))
    frames = [
        Frame(index, cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB), name=path.name)
        for index, path in enumerate(paths)
    ]
    box = json.loads((folder / "init.json").read_text())["bbox_xywh"]
    ious = []
    for path, estimate in zip(paths, track(frames, Prompt(tuple(box)), segmentation_size=224), strict=True):
        truth = folder / "masks" / f"{path.stem}.png"
        if truth.exists() and path.stem != "000000":
            true_mask = cv2.imread(str(truth), cv2.IMREAD_GRAYSCALE) > 127
            ious.append(0.0 if estimate.mask is None else iou(estimate.binary, true_mask))
    assert np.mean(ious) > expected


def test_a_box_that_was_corrected_keeps_its_offset() -> None:
    followed, told = (40.0, 30.0, 20.0, 10.0), (38.0, 30.0, 30.0, 12.0)
    offset = BoxOffset.between(followed, told)
    assert offset.apply(followed) == pytest.approx(told)
    assert offset.apply((80.0, 60.0, 40.0, 20.0)) == pytest.approx((76.0, 60.0, 60.0, 24.0))
    assert BoxOffset().apply(followed) == followed


def test_what_a_correction_adds_is_not_held_back_by_the_box_of_before() -> None:
    frames, truth = moving_shape(6)
    half = truth[0] & (
        np.arange(truth[0].shape[1]) < box_around(truth[0])[0] + box_around(truth[0])[2] * 0.75
    )
    csrt = tracker()
    csrt.init(frames[0], Prompt(box_around(half), half))
    csrt.step(frames[1])
    csrt.correct(frames[1], truth[1])
    assert iou(csrt.step(frames[2]).binary, truth[2]) > 0.9
