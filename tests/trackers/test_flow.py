"""The flow tracker: masks of known truth with every cue off in turn, leaving and coming back, correction."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from moving_shape import SIZE, box_around, clutter, iou, moving_shape
from pydantic import ValidationError

from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.geometry.camera import Window
from tracking3d.testing import check_tracker
from tracking3d.trackers.flow import FlowTracker
from tracking3d.trackers.protocol import CorrectableTracker, MaskTracker, Options
from tracking3d_bench.benchmark.mask_trackers import Contestant, measure_trackers
from tracking3d_bench.benchmark.sequences import open_dataset

OFF = [
    {"prior": 0.0},
    {"outline": 0.0},
    {"similarity": False},
    {"global_colours": 0.0},
    {"local_colours": 0.0},
    {"motion": 0.0},
    {"novelty": 0.0},
    {"smoother": False},
]


def tracker(**options: object) -> FlowTracker:
    """With a crop of 96 pixels a side where users have 224, unless that is said."""
    return FlowTracker.from_options(FlowTracker.Options(**{"segmentation_size": 96} | options))


def track(frames: list[Frame], prompt: Prompt, **options: object) -> list[MaskEstimate]:
    flow = tracker(**options)
    return [flow.init(frames[0], prompt), *(flow.step(frame) for frame in frames[1:])]


def ious(estimates: list[MaskEstimate], truth: np.ndarray) -> list[float]:
    return [iou(estimate.binary, mask) for estimate, mask in zip(estimates, truth, strict=True)]


def there_and_back(away: int = 4) -> tuple[list[Frame], np.ndarray]:
    """The hexagon drifts out of the frame at the right, stays away, and comes back."""
    frames, masks = moving_shape(14, step=16.0, turn=0.0, start=90.0)
    gone = masks.any((1, 2)).argmin()
    assert gone
    order = [*range(gone), *[gone] * away, *reversed(range(4, gone))]
    return [Frame(n, frames[at].image) for n, at in enumerate(order)], masks[order]


def a_new_side(count: int = 14) -> tuple[list[Frame], np.ndarray]:
    """A box that stands still while a side of other colours turns in from the left and pushes the first one out."""
    background = clutter(1, SIZE, (0, 40, 60), (90, 160, 255))
    sides = (
        clutter(2, (70, 80), (120, 30, 0), (255, 200, 90)),
        clutter(3, (70, 80), (20, 120, 10), (150, 255, 80)),
    )
    mask = np.zeros(SIZE, bool)
    mask[60:130, 80:160] = True
    frames = []
    for index in range(count):
        image = background.copy()
        seam = 4 * index
        image[60:130, 80:160] = np.hstack([sides[1][:, :seam], sides[0][:, : 80 - seam]])
        frames.append(Frame(index, image.round().astype(np.uint8)))
    return frames, np.stack([mask] * count)


def past_a_likeness(count: int = 14) -> tuple[list[Frame], np.ndarray]:
    """A patch moves along something of its colours, which lies there all the time."""
    background = clutter(1, SIZE, (0, 40, 60), (90, 160, 255))
    background[110:150, 90:150] = clutter(2, (40, 60), (120, 30, 0), (255, 200, 90))
    thing = clutter(3, (50, 50), (120, 30, 0), (255, 200, 90))
    frames, masks = [], np.zeros((count, *SIZE), bool)
    for index in range(count):
        image, place = background.copy(), np.s_[60:110, 20 + 6 * index : 70 + 6 * index]
        image[place], masks[index][place] = thing, True
        frames.append(Frame(index, image.round().astype(np.uint8)))
    return frames, masks


@pytest.mark.parametrize("witness", ["none", "kcf"])
def test_it_keeps_to_the_protocol(witness: str) -> None:
    check_tracker(FlowTracker, sizes=[(90, 120)], frames=2, segmentation_size=96, witness=witness)
    assert isinstance(tracker(), MaskTracker) and isinstance(tracker(), CorrectableTracker)


@pytest.mark.parametrize("with_mask", [False, True])
@pytest.mark.parametrize("witness", ["none", "csrt", "kcf"])
def test_a_moving_shape_is_followed(witness: str, with_mask: bool) -> None:
    frames, truth = moving_shape(12)
    prompt = Prompt(box_around(truth[0]), truth[0] if with_mask else None)
    estimates = track(frames, prompt, witness=witness)
    assert min(ious(estimates, truth)) > 0.9
    assert min(estimate.score for estimate in estimates) > 0.5


@pytest.mark.parametrize("off", OFF, ids=lambda off: next(iter(off)))
def test_every_cue_can_be_switched_off_and_is_missed_by_the_mask(off: dict[str, object]) -> None:
    frames, truth = moving_shape(6, step=6.0, turn=9.0)
    prompt = Prompt(box_around(truth[0]), truth[0])
    all_cues, without = track(frames, prompt), track(frames, prompt, **off)
    assert min(ious(without, truth)) > 0.8
    assert any((a.binary != b.binary).any() for a, b in zip(all_cues, without, strict=True))


@pytest.mark.parametrize("with_mask", [False, True])
def test_what_was_there_before_is_not_the_object(with_mask: bool) -> None:
    frames, truth = past_a_likeness()
    prompt = Prompt(box_around(truth[0]), truth[0] if with_mask else None)
    without, some, much = (
        min(ious(track(frames, prompt, segmentation_size=224, background=weight), truth))
        for weight in (0.0, 1.0, 2.0)
    )
    assert without < 0.8 < some < much
    assert much > 0.95


def test_a_side_that_turns_in_belongs_to_the_object() -> None:
    frames, truth = a_new_side()
    prompt = Prompt(box_around(truth[0]), truth[0])
    fine = {"segmentation_size": 224}
    assert ious(track(frames, prompt, **fine), truth)[-1] > 0.9
    assert ious(track(frames, prompt, **fine, outline=0.0, novelty=0.0, background=0.0), truth)[-1] < 0.8


def test_an_object_that_leaves_has_no_mask_and_is_found_when_it_comes_back() -> None:
    frames, truth = there_and_back()
    estimates = track(frames, Prompt(box_around(truth[0]), truth[0]))
    for estimate, mask in zip(estimates, truth, strict=True):
        if not mask.any():
            assert estimate.mask is None and estimate.score == 0
            assert estimate.reason == "the object is not visible"
    assert min(ious(estimates[-3:], truth[-3:])) > 0.85


def test_something_else_that_comes_in_is_not_taken_for_the_object() -> None:
    frames, truth = there_and_back()
    away = int(truth.any((1, 2)).argmin())
    grey = frames[away].image.copy()
    grey[40:120, 150:230] = (128, 128, 120)
    estimates = track(
        [*frames[: away + 1], Frame(0, grey), Frame(1, grey)], Prompt(box_around(truth[0]), truth[0])
    )
    assert estimates[-1].mask is None


@pytest.mark.parametrize(("separation", "taken"), [(0.3, False), (0.9, True)])
def test_what_is_found_again_must_look_like_the_object(monkeypatch, separation: float, taken: bool) -> None:
    frames, truth = there_and_back()
    away = int(truth.any((1, 2)).argmin())
    flow = tracker()
    flow.init(frames[0], Prompt(box_around(truth[0]), truth[0]))
    for frame in frames[1 : away + 1]:
        flow.step(frame)
    found = np.ones((64, 64), bool), Window(20, 20, 60, 64), separation
    monkeypatch.setattr("tracking3d.trackers.segmentation.find_by_colours", lambda *_: found)
    assert (flow.step(frames[away]).mask is not None) == taken


def test_a_correction_brings_a_wrong_start_back() -> None:
    frames, truth = moving_shape(8)
    for witness in ("none", "kcf"):
        flow = tracker(witness=witness)
        flow.init(frames[0], Prompt((180.0, 20.0, 30.0, 30.0)))
        wrong = flow.step(frames[1])
        assert wrong.mask is None or iou(wrong.binary, truth[1]) < 0.2
        flow.correct(frames[1], truth[1])
        after = [flow.step(frame) for frame in frames[2:]]
        assert min(ious(after, truth[2:])) > 0.85
        assert not any("box tracker" in estimate.reason for estimate in after)


def test_a_correction_is_background_no_more() -> None:
    frames, truth = moving_shape(1)
    still = [Frame(n, frames[0].image) for n in range(8)]
    flow = tracker(background=20)
    flow.init(still[0], Prompt((130.0, 70.0, 30.0, 30.0)))
    for frame in still[1:6]:
        flow.step(frame)
    flow.correct(still[5], truth[0])
    assert iou(flow.step(still[6]).binary, truth[0]) > 0.9


def test_a_correction_brings_back_what_was_out_of_sight() -> None:
    frames, truth = moving_shape(4)
    flow = tracker()
    flow.init(frames[0], Prompt((60.0, 60.0, 40.0, 40.0), np.zeros(SIZE, bool)))
    flow.correct(frames[1], truth[1])
    assert iou(flow.step(frames[2]).binary, truth[2]) > 0.9


def test_a_correction_keeps_a_witness_that_is_on_the_object_and_renews_one_that_has_strayed() -> None:
    frames, truth = moving_shape(4)
    flow = tracker(witness="csrt")
    flow.init(frames[0], Prompt(box_around(truth[0])))
    learnt = flow._box_tracker
    flow.step(frames[1])
    flow.correct(frames[1], truth[1])
    assert flow._box_tracker is learnt
    flow.step(frames[2])
    flow.correct(frames[2], np.roll(truth[2], 20, axis=1))
    assert flow._box_tracker is not learnt


def test_an_empty_correction_changes_nothing() -> None:
    frames, truth = moving_shape(3)
    flow = tracker()
    flow.init(frames[0], Prompt(box_around(truth[0])))
    flow.correct(frames[0], np.zeros(SIZE, bool))
    assert iou(flow.step(frames[1]).binary, truth[1]) > 0.9


def test_answers_do_not_depend_on_later_frames() -> None:
    frames, truth = moving_shape(6)
    prompt = Prompt(box_around(truth[0]))
    black = [Frame(index, np.zeros((*SIZE, 3), np.uint8)) for index in (4, 5)]
    for a, b in zip(track(frames, prompt)[:4], track(frames[:4] + black, prompt)[:4], strict=True):
        np.testing.assert_array_equal(a.mask, b.mask)


def test_a_cut_to_black_is_answered_with_a_low_score() -> None:
    frames, truth = moving_shape(4)
    black = Frame(4, np.zeros((*SIZE, 3), np.uint8))
    estimates = track([*frames, black, black], Prompt(box_around(truth[0])))
    assert estimates[-1].score < 0.4 < estimates[3].score


def test_a_witness_that_disagrees_lowers_the_score() -> None:
    frames, truth = moving_shape(6)
    prompt = Prompt(box_around(truth[0]), truth[0])
    flow = tracker(witness="kcf")
    flow.init(frames[0], prompt)
    flow._box_tracker.update = lambda image: (0.0, 0.0, 20.0, 20.0)
    misled = flow.step(frames[1])
    assert misled.reason == "the mask and the box tracker disagree"
    assert misled.score < track(frames, prompt)[1].score - 0.3


@pytest.mark.parametrize("box", [(300.0, 10.0, 20.0, 20.0), (-50.0, -50.0, 40.0, 40.0)])
def test_a_box_outside_the_frame_is_an_input_error(box: tuple[float, float, float, float]) -> None:
    frames, _ = moving_shape(1)
    with pytest.raises(InputError, match="outside frame 0"):
        tracker().init(frames[0], Prompt(box))


@pytest.mark.parametrize("size", [(8, 8), (5, 300), (33, 1)])
def test_tiny_frames_are_answered(size: tuple[int, int]) -> None:
    images = np.random.default_rng(0).integers(0, 256, (3, *size, 3), np.uint8)
    frames = [Frame(index, image) for index, image in enumerate(images)]
    for estimate in track(frames, Prompt((0.0, 0.0, float(size[1]), float(size[0])))):
        assert estimate.mask is None or estimate.mask.shape == size


def test_options_are_checked() -> None:
    for wrong in ({"prior": -1}, {"prier": 1}, {"witness": "nano"}, {"segmentation_size": 10}):
        with pytest.raises(ValidationError):
            FlowTracker.Options(**wrong)
    with pytest.raises(PluginError):
        FlowTracker.from_options(Options())
    assert all(field.description for field in FlowTracker.Options.model_fields.values())


def test_a_frame_before_the_start_is_a_plugin_error() -> None:
    with pytest.raises(PluginError):
        tracker().step(moving_shape(1)[0][0])


def test_a_correction_before_the_start_is_ignored() -> None:
    frames, truth = moving_shape(1)
    tracker().correct(frames[0], truth[0])


def test_the_random_state_does_not_matter() -> None:
    frames, truth = moving_shape(4)
    runs = []
    for seed in (1, 2):
        cv2.setRNGSeed(seed)
        runs.append(track(frames, Prompt(box_around(truth[0]))))
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a.mask, b.mask)
        assert a.score == b.score


@pytest.mark.slow
@pytest.mark.parametrize("witness", ["none", "csrt"])
def test_real_clips_from_a_box(shared_data: Path, monkeypatch: pytest.MonkeyPatch, witness: str) -> None:
    monkeypatch.setenv("TRACKING3D_PLUGINS", "tracking3d.trackers:flow=tracking3d.trackers.flow:FlowTracker")
    clips = open_dataset("real", shared_data, shared_data, 1)
    flow = Contestant.of(PluginChoice(name="flow", witness=witness))
    figures = [one.figures()["iou_mean"] for one in measure_trackers([flow], clips)]
    results = [one for one in figures if one is not None]  # some clips have no masks
    assert len(results) >= 4
    # cube_in_hand hangs in the balance: fingers are taken along, or not (docs/masks.md).
    assert np.mean(results) > 0.75 and min(results) > 0.5
    assert sorted(results)[1] > 0.7
