"""The tracker keeps the VOT toolkit's contract: regions in and out, confidence, errors that the toolkit can tell."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from sample_objects import QUICK, sample_clip, write_frames

from tracking3d.errors import InputError
from tracking3d.frames import Frame
from tracking3d_bench.evaluation.metrics import mask_iou
from tracking3d_bench.vot import VotTracker
from tracking3d_bench.vot.regions import MaskRows, place_mask, prompt_of, rectangle_of
from tracking3d_bench.vot.sessions import configuration


@pytest.fixture(scope="module")
def clip():
    return sample_clip()


@pytest.fixture(scope="module")
def paths(clip, tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("frames"), clip)


@pytest.fixture
def tracker():
    return VotTracker(overrides=QUICK)


def mask_region(mask):
    """As the toolkit hands masks over."""
    return mask.astype(np.uint8), {}


# The tracker


def test_a_rectangle_starts_and_frames_are_paths(tracker, clip, paths):
    ((_, properties),) = tracker.init(paths[0], [(clip.box, {})], {})
    assert 0 <= properties["confidence"] <= 1 and type(properties["confidence"]) is float
    for path, truth in zip(paths[1:], clip.masks[1:], strict=True):
        ((region, properties),) = tracker.update(path, [], {})
        assert mask_iou(np.array(region, dtype=bool), truth) > 0.6
        assert set(properties) == {"confidence"}


def test_a_mask_starts_and_is_the_first_answer_nearly(tracker, clip, paths):
    ((region, _),) = tracker.init(paths[0], [mask_region(clip.masks[0])], {})
    assert mask_iou(np.array(region, dtype=bool), clip.masks[0]) > 0.7


def test_masks_are_nested_lists_that_the_toolkit_can_take_for_an_array(tracker, clip, paths):
    ((region, _),) = tracker.init(paths[0], [mask_region(clip.masks[0])], {})
    region = pickle.loads(pickle.dumps(region))  # it comes from another process
    assert isinstance(region, list) and all(isinstance(row, list) for row in region)
    assert not all(isinstance(row, tuple) for row in region)
    array = region.astype(np.uint8)
    assert array.shape == (64, 80) and array.dtype == np.uint8 and set(np.unique(array)) == {0, 1}


def test_rectangles_are_answered_where_they_are_asked_for(clip, paths):
    tracker = VotTracker(overrides=QUICK, region="rectangle")
    ((region, _),) = tracker.init(paths[0], [mask_region(clip.masks[0])], {})
    assert type(region) is tuple and all(type(side) is float for side in region)
    np.testing.assert_allclose(region, clip.box, atol=6)


def test_objects_may_come_later_and_are_answered_in_order(tracker, clip, paths):
    assert len(tracker.init(paths[0], [mask_region(clip.masks[0])], {})) == 1
    late = clip.masks[1].copy()
    late[:, : int(np.nonzero(late)[1].mean())] = False
    first, second = tracker.update(paths[1], [mask_region(late)], {})
    assert np.sum(first[0]) > 1.4 * np.sum(second[0])
    assert len(tracker.update(paths[2], [], {})) == 2


def test_one_object_may_come_without_a_list_around_it(tracker, clip, paths):
    assert len(tracker.init(paths[0], (clip.box, {}), {})) == 1


def test_no_object_gives_no_answer_until_one_comes(tracker, clip, paths):
    assert tracker.init(paths[0], [], {}) == []
    assert len(tracker.update(paths[1], [mask_region(clip.masks[1])], {})) == 1


def test_init_begins_afresh(tracker, clip, paths):
    first = tracker.init(paths[0], [(clip.box, {})], {})
    tracker.update(paths[1], [], {})
    again = tracker.init(paths[0], [(clip.box, {})], {})
    assert len(again) == 1 and again[0][0] == first[0][0]


def test_of_several_channels_the_colour_is_taken(tracker, clip, paths):
    frame = {"depth": np.zeros((64, 80), np.uint8), "color": clip.images[0]}
    by_channel = tracker.init(frame, [(clip.box, {})], {})
    assert by_channel[0][0] == tracker.init(paths[0], [(clip.box, {})], {})[0][0]


def test_a_grey_image_is_taken_too(tracker, clip):
    assert len(tracker.init(clip.images[0, ..., 1], [mask_region(clip.masks[0])], {})) == 1


def test_the_tracker_says_that_it_follows_several_objects():
    assert VotTracker.multiobject is True


# Errors come as those which the toolkit passes on


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"preset": "no-such"}, "no-such"),
        ({"config": "no-such.yaml"}, r"no-such\.yaml"),
        ({"overrides": "solver.speed=1"}, "speed"),
        ({"region": "polygon"}, "polygon"),
    ],
)
def test_arguments_that_cannot_be_used_are_named(arguments, message):
    with pytest.raises(RuntimeError, match=message):
        VotTracker(**arguments)


@pytest.mark.parametrize(
    "region",
    [
        (0.0, 0.0, 0.0, 0.0),
        (500.0, 500.0, 20.0, 20.0),
        (1.0, 2.0),
        [],
        "text",
        np.zeros((64, 80), np.uint8),
        np.zeros((3, 64, 80)),
        [(1.0, 2.0), (3.0, 4.0)],
        [(1.0, 2.0), (30.0, 4.0), (30.0, float("nan"))],
        None,
    ],
    ids=repr,
)
def test_a_first_region_that_marks_nothing_is_refused(tracker, paths, region):
    with pytest.raises(RuntimeError):
        tracker.init(paths[0], [(region, {})], {})


def test_frames_that_cannot_be_used_are_refused(tracker, clip, tmp_path):
    with pytest.raises(RuntimeError, match=r"nowhere\.png"):
        tracker.init(str(tmp_path / "nowhere.png"), [(clip.box, {})], {})
    with pytest.raises(RuntimeError, match="channels depth"):
        tracker.init({"depth": clip.images[0]}, [(clip.box, {})], {})
    with pytest.raises(RuntimeError, match="frames must have one size"):
        tracker.init(clip.images[0], [(clip.box, {})], {})
        tracker.update(clip.images[1][:-2], [], {})


# Settings


def test_the_preset_may_be_in_the_environment_and_an_argument_wins(monkeypatch):
    default = configuration()
    monkeypatch.setenv("TRACKING3D_PRESET", "paper")
    assert configuration() == configuration(preset="paper") != default
    assert configuration(preset="default") == default


def test_a_file_and_overrides_are_heard(tmp_path):
    (tmp_path / "fast.yaml").write_text("solver: {weights: {points: 3}}\n")
    config = configuration(str(tmp_path / "fast.yaml"), overrides="crop.size=48 object.texture_size=32")
    assert (config.solver.weights.points, config.crop.size, config.object.texture_size) == (3, 48, 32)


# Regions


def frame(height=20, width=30):
    return Frame(0, np.zeros((height, width, 3), np.uint8))


def test_a_mask_smaller_than_the_frame_lies_at_its_offset():
    mask = prompt_of(np.ones((3, 4), np.uint8), frame(), offset=(10, 5)).mask
    y, x = np.nonzero(mask)
    assert mask.shape == (20, 30) and mask.sum() == 12
    assert (x.min(), x.max(), y.min(), y.max()) == (10, 13, 5, 7)


def test_a_mask_beyond_the_frame_is_cut_off():
    ones = np.ones((10, 10), bool)
    assert (
        place_mask(ones, (-4, -7), (20, 30))[:3, :6].all()
        and place_mask(ones, (-4, -7), (20, 30)).sum() == 6 * 3
    )
    assert place_mask(ones, (25, 15), (20, 30)).sum() == 5 * 5
    assert place_mask(ones, (40, 0), (20, 30)).sum() == 0
    assert place_mask(ones, (-10, -20), (20, 30)).sum() == 0
    assert place_mask(np.ones((40, 50), bool), (0, 0), (20, 30)).all()


def test_a_polygon_is_filled():
    prompt = prompt_of([(5.0, 5.0), (15.0, 5.0), (15.0, 12.0), (5.0, 12.0)], frame())
    assert prompt.mask[8, 10] and not prompt.mask[3, 10] and 60 < prompt.mask.sum() < 100


def test_rows_of_numbers_are_a_mask():
    rows = np.zeros((20, 30), int)
    rows[4:6, 7:9] = 1
    assert prompt_of(rows.tolist(), frame()).box == (7, 4, 2, 2)


def test_a_first_region_of_no_kind_is_told_in_one_sentence():
    with pytest.raises(InputError, match="no rectangle, polygon or mask"):
        prompt_of("x", frame())


def test_an_empty_mask_has_an_empty_rectangle():
    assert rectangle_of(np.zeros((4, 5), bool)) == (0, 0, 0, 0)


def test_rows_keep_the_mask():
    mask = np.eye(3, 4) > 0
    assert (MaskRows.of(mask).astype(bool) == mask).all()
