"""The tracker segment: the weights of the package on clips of known truth, and how it prompts its network."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tracking3d.config.models import PluginChoice
from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, Prompt
from tracking3d.results.files import read_mask
from tracking3d.testing import check_tracker
from tracking3d.testing.trackers import moving_disc
from tracking3d.trackers.crops import box_of
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.first_mask import mask_with_network
from tracking3d.trackers.protocol import CorrectableTracker, MaskTracker
from tracking3d.trackers.segment.network import ObjectNetwork
from tracking3d.trackers.segment.tracker import NetworkCue, SegmentTracker, _settle
from tracking3d.video.image_file import read_image
from tracking3d_bench.benchmark.mask_trackers import Contestant, measure_trackers
from tracking3d_bench.benchmark.sequences import open_dataset


def tracker(**options: object) -> SegmentTracker:
    return SegmentTracker.from_options(SegmentTracker.Options(**options))


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return np.count_nonzero(one & other) / np.count_nonzero(one | other)


def test_it_conforms():
    assert isinstance(tracker(), MaskTracker)
    assert isinstance(tracker(), CorrectableTracker)
    check_tracker(SegmentTracker, sizes=((90, 120),), frames=3)


@pytest.mark.parametrize("with_mask", [False, True])
def test_a_disc_is_followed(with_mask):
    clip = moving_disc((120, 160), 15)
    segment = tracker()
    estimates = [segment.init(clip.frames[0], clip.prompt(with_mask)), *map(segment.step, clip.frames[1:])]
    for index, estimate in enumerate(estimates):
        assert iou(estimate.binary, np.roll(clip.mask, 2 * index, axis=1)) > 0.9, index


def test_the_same_frames_give_the_same_masks():
    clip = moving_disc((90, 120), 5)

    def masks() -> list[np.ndarray]:
        segment = tracker()
        return [
            segment.init(clip.frames[0], clip.prompt(False)).mask,
            *(segment.step(one).mask for one in clip.frames[1:]),
        ]

    for one, other in zip(masks(), masks(), strict=True):
        assert np.array_equal(one, other)


def test_a_correction_is_continued():
    clip = moving_disc((120, 160), 8)
    half = clip.mask & (np.arange(160) < np.nonzero(clip.mask)[1].mean())
    segment = tracker()
    segment.init(clip.frames[0], Prompt(box_of(half), half))
    segment.step(clip.frames[1])
    segment.correct(clip.frames[1], np.roll(clip.mask, 2, axis=1))
    for index in range(2, 8):
        estimate = segment.step(clip.frames[index])
    assert iou(estimate.binary, np.roll(clip.mask, 14, axis=1)) > 0.9


def test_the_network_segments_a_box_of_a_still_image_and_nothing_beyond_its_crop():
    clip = moving_disc((160, 240), 1)
    likely, _ = ObjectNetwork().segment_box(clip.frames[0].image, clip.box)
    assert likely.shape == (160, 240)
    assert iou(likely > 0.5, clip.mask) > 0.85
    assert likely[:, :10].max() < 1e-6


def test_a_box_at_the_border_of_the_frame_is_segmented():
    clip = moving_disc((160, 240), 1)
    x, y, width, height = clip.box
    image = np.ascontiguousarray(clip.frames[0].image[:, round(x + width / 2) :])
    truth = clip.mask[:, round(x + width / 2) :]
    likely, _ = ObjectNetwork().segment_box(image, (0.0, y, width / 2, height))
    assert iou(likely > 0.5, truth) > 0.8


def test_without_an_opinion_of_the_network_the_first_mask_is_that_of_colours():
    clip = moving_disc((120, 160), 1)
    nothing = np.zeros((120, 160), np.float32)
    assert iou(mask_with_network(clip.frames[0].image, clip.box, nothing) > 0.5, clip.mask) > 0.8


def test_a_remembered_box_grows_at_once_and_shrinks_slowly():
    remembered = (10.0, 10.0, 40.0, 40.0)
    assert _settle(remembered, (0.0, 10.0, 60.0, 40.0)) == pytest.approx((0, 10, 60, 40))
    left, top, width, height = _settle(remembered, (20.0, 10.0, 30.0, 40.0))
    assert (left, left + width) == pytest.approx((11, 50))
    assert (top, height) == pytest.approx((10, 40))
    for _ in range(40):
        remembered = _settle(remembered, (20.0, 10.0, 30.0, 40.0))
    assert remembered == pytest.approx((20, 10, 30, 40), abs=0.2)


def test_a_remembered_box_is_never_far_larger_than_the_mask():
    left, _, width, _ = _settle((0.0, 0.0, 400.0, 40.0), (100.0, 0.0, 20.0, 40.0))
    assert left == pytest.approx(100 - 9)
    assert left + width == pytest.approx(120 + 9)


def test_the_prompt_moves_with_the_mask_and_is_replaced_by_a_correction(monkeypatch):
    clip = moving_disc((120, 160), 4)
    prompts = []

    class Recording(ObjectNetwork):
        def log_odds(self, image, carried, motion, window, colours, box):
            prompts.append(box)
            return super().log_odds(image, carried, motion, window, colours, box)

    x, _, width, _ = clip.box
    segment = tracker()
    segment._network = Recording()
    segment.init(clip.frames[0], clip.prompt(True))
    assert isinstance(segment._state.cue, NetworkCue)
    for frame in clip.frames[1:]:
        segment.step(frame)
    centres = [box[0] + box[2] / 2 for box in prompts]
    assert centres == pytest.approx([x + width / 2 + 2 * k for k in (1, 2, 3)], abs=1.5)
    assert all(box[2] >= width for box in prompts)


@pytest.mark.parametrize("corrected", [False, True])
def test_announced_frames_give_the_same_masks(corrected):
    clip = moving_disc((90, 120), 6)

    def masks(announced: bool) -> list[np.ndarray]:
        segment = tracker()
        found = [segment.init(clip.frames[0], clip.prompt(False)).mask]
        for frame, coming in zip(clip.frames[1:-1], clip.frames[2:], strict=True):
            found.append(segment.step(frame).mask)
            if announced:
                segment.announce(coming)
            if corrected and frame.index == 2:
                segment.correct(frame, np.roll(found[-1] > 0.5, 3, axis=0))
        return [*found, segment.step(clip.frames[-1]).mask]

    for one, other in zip(masks(True), masks(False), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_is_in_front_comes_with_the_mask_and_only_once():
    clip = moving_disc((120, 160), 3)

    class Hand(ObjectNetwork):
        def log_odds(self, image, carried, motion, window, colours, box):
            by_mask, by_box, occluder = super().log_odds(image, carried, motion, window, colours, box)
            occluder[:, : occluder.shape[1] // 2] = 4
            occluder[:, occluder.shape[1] // 2 :] = -4
            return by_mask, by_box, occluder

    segment = tracker()
    segment._network = Hand()
    segment.init(clip.frames[0], clip.prompt(True))
    estimate = segment.step(clip.frames[1])
    middle = round(box_of(estimate.binary)[0] + box_of(estimate.binary)[2] / 2)
    assert not (estimate.occluder & estimate.binary).any()
    beside = np.roll(clip.mask, 2, axis=1) & ~estimate.binary
    assert estimate.occluder[:, :middle].any() and not estimate.occluder[:, middle + 8 :].any()
    assert beside.sum() < 0.1 * clip.mask.sum()
    assert segment._state.cue.take_occluder(clip.frames[1].image.shape) is None


def test_what_is_in_front_of_a_given_mask_leaves_it_whole_and_no_gap_beside_it():
    clip = moving_disc((120, 160), 1)

    class Hand(ObjectNetwork):
        def _run(self, crops):
            logits = np.full((len(crops), 2, 160, 160), -4, np.float32)
            logits[:, 1, :, 120:] = 4
            return logits

    occluder = Hand().occluder(clip.frames[0].image, clip.mask)
    assert not (occluder & clip.mask).any() and occluder.any()
    assert not Hand().occluder(clip.frames[0].image, clip.mask & False).any()


def test_a_hand_that_holds_a_cube_is_in_front_of_it_and_nothing_is_in_front_of_a_car(shared_data: Path):
    def share(clip: str) -> float:
        image = read_image(shared_data / clip / "frames" / "000000.jpg")
        mask = read_mask(shared_data / clip / "masks" / "000000.png")
        return ObjectNetwork().occluder(image, mask).sum() / mask.sum()

    assert share("cube_in_hand") > 0.1
    assert share("car_shadow") < 0.02


def test_a_box_outside_and_a_frame_before_the_start_are_refused():
    image = np.zeros((60, 80, 3), np.uint8)
    with pytest.raises(InputError, match="lies outside"):
        tracker().init(Frame(0, image), Prompt((200.0, 0.0, 20.0, 20.0)))
    with pytest.raises(PluginError, match="started with init"):
        tracker().step(Frame(0, image))


@pytest.mark.slow
def test_real_clips_from_a_box(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(
        "TRACKING3D_PLUGINS", "tracking3d.trackers:segment=tracking3d.trackers.segment.tracker:SegmentTracker"
    )
    clips = open_dataset("real", shared_data, shared_data, 1)
    figures = [
        one.figures()["iou_mean"]
        for one in measure_trackers([Contestant.of(PluginChoice(name="segment"))], clips)
    ]
    results = [one for one in figures if one is not None]  # some clips have no masks
    assert len(results) >= 4
    assert np.mean(results) > 0.87
    assert min(results) > 0.75


def test_colours_are_favoured_as_far_as_they_are_the_object_s_alone():
    cues = Cues(network=3.0, global_colours=0.5, local_colours=0.5)
    assert cues.favour_colours(0.0) == cues
    full = cues.favour_colours(1.0)
    assert (full.network, full.global_colours, full.local_colours) == pytest.approx((1.0, 1.5, 1.5))
    assert (full.motion, full.prior) == (cues.motion, cues.prior)


def test_a_ring_of_another_colour_than_the_background_keeps_its_hole():
    yy, xx = np.mgrid[:160, :200]
    images = []
    for shift in range(6):
        radius = np.hypot(xx - 80 - 3 * shift, yy - 80)
        ring = (radius < 45) & (radius > 22)
        images.append((np.where(ring[..., None], (230, 190, 60), (20, 20, 25)).astype(np.uint8), ring))
    segment = tracker()
    image, ring = images[0]
    segment.init(Frame(0, image), Prompt((35.0, 35.0, 90.0, 90.0)))
    for index, (image, ring) in enumerate(images[1:], 1):
        assert iou(segment.step(Frame(index, image)).binary, ring) > 0.85, index
